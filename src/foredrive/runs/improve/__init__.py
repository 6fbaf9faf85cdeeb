"""The closed loop: failures of drives, moments that resemble them, training on these, drives again."""
