"""Settings, sites, maps and robot files, read and validated with the place and the remedy of each error."""
