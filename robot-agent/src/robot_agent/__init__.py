"""The robot's agent and guardian: localization, path following, the safety gate, and the base's serial port."""
