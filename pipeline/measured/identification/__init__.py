"""Identification of a device from all logs of an experiment, with one model, one likelihood and one type of
interval."""
