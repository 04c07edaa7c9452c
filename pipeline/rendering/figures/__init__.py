"""Figures as SVG from computed results."""
