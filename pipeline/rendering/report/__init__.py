"""Report pages from finished numbers."""
