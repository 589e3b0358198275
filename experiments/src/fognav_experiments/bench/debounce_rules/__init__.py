"""The comparison of debounce rules on recorded echoes (`fognav bench debounce`)."""
