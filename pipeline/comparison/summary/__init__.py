"""Conclusions of a comparison: answers, recommended walls, and warnings."""
