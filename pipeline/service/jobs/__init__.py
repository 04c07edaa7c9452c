"""Jobs: what they compute, and the processes that do."""
