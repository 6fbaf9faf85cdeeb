"""The static content of a town (roads, land, houses, street furniture) and the shapes of road users."""
