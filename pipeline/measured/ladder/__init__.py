"""The ladder of loops: one device fitted to all trials of an experiment, with as few parts as explain them."""
