"""Delay, mass and damping of a trial by one model of its whole response."""
