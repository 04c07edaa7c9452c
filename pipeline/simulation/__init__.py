"""Simulation of devices and of the sweep over walls that a lab performs with them."""
