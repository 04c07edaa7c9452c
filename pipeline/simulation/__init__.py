"""Simulated devices, and the course of experiments that a lab would run on them."""
