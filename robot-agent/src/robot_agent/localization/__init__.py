"""Localization: odometry buffer, deskewing, map fields, particle filter, fit monitor, global search."""
