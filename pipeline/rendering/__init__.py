"""Figures, tables and pages from finished records."""
