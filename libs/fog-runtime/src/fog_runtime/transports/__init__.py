"""MQTT and zenoh: typed channels between processes."""
