"""Evaluation of a single log: response, modes, verdict, outcome, and events."""
