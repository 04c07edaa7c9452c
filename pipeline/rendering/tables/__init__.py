"""Tables of a report: columns, formats and reasons for empty cells."""
