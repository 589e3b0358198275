"""The aggregator's REST API: areas, their history, overrides and alerts."""
