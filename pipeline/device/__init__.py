"""One device in a sampled control loop: its record, its parts and the table of its parameters."""
