"""What sensors would see of a scene made of Gaussians."""
