"""The thesis's experiment: the same drives by robots that plan for themselves and by one that the fog leads."""
