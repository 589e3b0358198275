"""Zones as other programs draw them: GeoJSON, and the masks of Nav2."""
