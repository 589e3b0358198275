"""How soon the wheels of a robot stop after a fault: a real robot with emulated devices, and a table of faults."""
