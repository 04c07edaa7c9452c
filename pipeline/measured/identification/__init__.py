"""Identification of an experiment by one model, one likelihood and one interval: from logs to a device."""
