"""What stands in a town: roads, land, houses, street furniture, the shapes of road users."""
