"""The process that owns the wheels, the watchdog that outlives it, and what they tell the agent."""
