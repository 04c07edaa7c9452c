"""Identification of a device from all logs of an experiment, by one model, one likelihood and one type of interval."""
