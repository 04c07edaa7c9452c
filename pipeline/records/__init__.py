"""Data that is passed on and stored: frozen records, arrays of trials, the dictionary of stored columns."""
