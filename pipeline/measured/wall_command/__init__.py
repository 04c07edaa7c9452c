"""Comparison of a log's command with the wall law; a departure is named only if it is identified, never guessed."""
