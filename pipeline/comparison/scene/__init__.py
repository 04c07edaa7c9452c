"""Scene of a comparison: its parts, its file and its origin."""
