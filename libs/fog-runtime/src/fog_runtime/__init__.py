"""Edges of Fognav's processes: settings, MQTT, zenoh, clock, freshness, metrics, health, logs, sites, record and replay."""
