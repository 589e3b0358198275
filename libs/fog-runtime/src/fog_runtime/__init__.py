"""I/O of Fognav's processes: settings, MQTT, zenoh, clock, metrics, health, logs, sites, recording and replay."""
