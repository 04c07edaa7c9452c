"""Evaluate a single log: its response, modes, verdict, outcome, and events."""
