"""VDA 5050, versions 3.0, 2.1 and 2.0: robots under a fleet control, and zones for other makers' robots."""
