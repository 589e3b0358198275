"""The process that localizes, follows and judges: core, edges, settings."""
