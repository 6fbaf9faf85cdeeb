"""Python functions that return one frozen configuration each, and what runs them."""
