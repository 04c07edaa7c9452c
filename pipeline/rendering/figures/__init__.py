"""Figures as SVG from finished numbers."""
