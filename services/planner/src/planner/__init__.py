"""Plans paths by A* on the master costmap and replans when a change matters."""
