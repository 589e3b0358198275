"""Robots that ride lifts from this floor to others, and from others to this one (ADR 76)."""
