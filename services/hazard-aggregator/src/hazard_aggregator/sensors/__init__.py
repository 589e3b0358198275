"""Nodes and sources: what one reading means, and the confirmed state of its sender. Pure."""
