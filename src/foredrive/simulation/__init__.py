"""The closed loop: how the ego vehicle moves and follows a plan, where it has to go, how it is scored."""
