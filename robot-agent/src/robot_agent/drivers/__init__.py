"""Drivers: the wire protocols of the robot's devices, and the one place that touches a serial port."""
