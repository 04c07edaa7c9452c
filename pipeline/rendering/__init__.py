"""Figures, tables and pages from computed results."""
