"""Wait or detour: how long blocks of an area last, and whether a robot waits for one to end or goes round."""
