"""VDA 5050, versions 3.0, 2.1, 2.0 and 1.1: robots under a fleet control, and zones for other makers' robots."""
