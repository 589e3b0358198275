"""Leases of path corridors, by which robots make room for one another (ADR 71)."""
