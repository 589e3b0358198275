"""What Linux tells of the computer and the process: clock, signals, memory, threads, temperature, service manager."""
