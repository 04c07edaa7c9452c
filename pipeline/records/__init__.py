"""Frozen records and arrays of trials that functions exchange or store, and the dictionary of stored columns."""
