"""Thin command-line verbs over the package."""
