"""Delay, mass, damping and friction of a device, each by a method of its own."""
