"""Comparison of a log's command with the wall law: each departure has a name, or none, never a guess."""
