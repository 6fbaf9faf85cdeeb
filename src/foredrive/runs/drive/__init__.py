"""Closed-loop drives over suites of routes, and recording drives through towns."""
