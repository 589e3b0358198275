"""Shows a floor live in Foxglove, over its WebSocket."""
