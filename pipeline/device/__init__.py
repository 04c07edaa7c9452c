"""Record of a device in a sampled control loop, its parts and the table of its parameters."""
