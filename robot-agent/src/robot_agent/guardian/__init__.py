"""The guardian that owns the base, the watchdog that monitors it, and their messages to the agent."""
