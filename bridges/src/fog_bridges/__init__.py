"""Bridges to other systems: they read a floor's console and use its REST, and nothing of Fognav imports them."""
