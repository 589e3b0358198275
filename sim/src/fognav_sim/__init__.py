"""Simulated world with wire-level Roomba, RPLidar and sensor nodes."""
