"""Where compiled kernels are kept, and which sources they come from."""
