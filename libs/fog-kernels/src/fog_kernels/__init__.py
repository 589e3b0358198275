"""Compiled kernels: A*, inflation, ray casting, likelihood field, particle filter, DWA.

Import the submodule that is needed: none imports another one's kernels without using them, so a robot loads only
its own. Every kernel is compiled, or loaded from numba's cache, when its module is imported and never later: all
signatures are explicit, and arrays of another type are refused instead of being compiled for.
"""
