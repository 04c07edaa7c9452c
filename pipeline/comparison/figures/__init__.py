"""Figures and trials of a report that need what is stored of the logs: cost maps, responses, the explorer's data."""
