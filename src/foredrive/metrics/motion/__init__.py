"""Forecasts of agents' motion, judged by every published protocol."""
