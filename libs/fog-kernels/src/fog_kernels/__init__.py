"""Compiled kernels: A*, inflation, ray casting, likelihood field, particle filter, DWA.

Import only the submodules that are needed: none imports another without using it, so a process loads only its own
kernels. Every kernel is compiled, or loaded from numba's cache, when its module is imported and never later: all
signatures are explicit, and arrays of other types are refused.
"""
