"""What one log shows: response, modes, verdict, outcome, events."""
