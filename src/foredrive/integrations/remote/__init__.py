"""Planners and renderers of other programs, over HTTP and gRPC: both ends of their protocols."""
