"""Edges of Fognav's processes: settings, MQTT, zenoh, clock, metrics, health, logs, sites, record and replay."""
