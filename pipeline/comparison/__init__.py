"""Comparison of measurements with theory: scenes, scores, tables, figures and summaries."""
