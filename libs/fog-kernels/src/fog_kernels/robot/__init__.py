"""What the kernels are told of a robot: its outline, the limits of its base, and how its motion is chosen."""
