"""A fog node on this machine without containers: `fognav up`, `down` and `logs`."""
