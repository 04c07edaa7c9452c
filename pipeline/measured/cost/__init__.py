"""Costs of a recorded response, with intervals."""
