"""Simulated world with wire-level robot hardware and sensor nodes."""
