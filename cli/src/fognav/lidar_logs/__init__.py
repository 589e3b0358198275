"""Localization on recorded logs: reading logs, building maps from them, and evaluating the particle filter."""
