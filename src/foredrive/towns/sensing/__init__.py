"""What cameras and lidars make of a town: rays, light and returns."""
