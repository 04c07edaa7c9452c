"""Log profiles: drafts, checks on samples, warnings."""
