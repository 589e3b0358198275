"""Debounces and fuses sensor nodes into one state per area."""
