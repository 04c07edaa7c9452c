"""Conclusions of a comparison, in sentences."""
