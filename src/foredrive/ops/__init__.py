"""Kernels. Each fast path has a reference version in plain PyTorch."""
