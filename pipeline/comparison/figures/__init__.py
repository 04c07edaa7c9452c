"""Arrays behind the figures of a comparison."""
