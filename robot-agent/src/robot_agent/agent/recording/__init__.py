"""The log of all inputs of the agent's core, and its replay."""
