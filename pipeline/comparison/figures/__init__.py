"""Figures and trials of a report that need the stored logs. They are cost maps, responses, and data of the explorer."""
