"""Evaluate a single log for its response, modes, verdict, outcome, and events."""
