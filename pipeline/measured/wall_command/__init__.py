"""Compare the command of a log with the wall law. A departure is named only if it is identified."""
