"""Tensor maths: rigid motions, projection and boxes. The frames are defined in docs/conventions.md."""
