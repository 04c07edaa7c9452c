"""Frozen records, arrays of trials, and the dictionary of stored columns, which functions exchange or store."""
