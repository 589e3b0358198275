"""Lidars, one folder each."""
