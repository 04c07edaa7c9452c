"""Costs of a step response: settling time, overshoot, energies, at points and on grids."""
