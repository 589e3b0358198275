"""Compiled kernels: A*, inflation, ray casting, likelihood field, particle filter, DWA."""
