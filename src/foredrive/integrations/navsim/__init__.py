"""Agents of NAVSIM's interface."""
