"""Kernels, each with a plain PyTorch reference beside its fast path."""
