"""Report pages from computed results."""
