"""Costs of recorded step responses, with 95 % intervals."""
