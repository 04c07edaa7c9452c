"""Intake of log files as stored trials: find, read and check logs, skip known logs, refuse or store the others."""
