"""Simulated devices, and the sweep over walls that a lab would run on them."""
