"""LDROBOT LD19, also sold as LD06 with another housing."""
