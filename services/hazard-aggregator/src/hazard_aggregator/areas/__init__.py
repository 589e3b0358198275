"""Areas: the fusion of an area's nodes and sources to one state, its history, overrides and alerts. Pure."""
