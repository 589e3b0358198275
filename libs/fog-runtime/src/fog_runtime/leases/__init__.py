"""Leases: which of several copies of a service may act."""
