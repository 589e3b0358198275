"""The planner's REST API: robots with their missions, plans on request, and commands to robots."""
