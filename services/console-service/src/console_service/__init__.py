"""The console-service: the page, and one stream of events with the state of everything (ADR 67)."""
