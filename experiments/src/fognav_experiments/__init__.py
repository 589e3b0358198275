"""Every core wired in lockstep on a simulated clock, and the experiment on top."""
