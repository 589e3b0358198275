"""Random worlds, and an oracle that knows what must hold in all of them."""
