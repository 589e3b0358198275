"""The agent process: localization, path following and the safety gate, with its edges and settings."""
