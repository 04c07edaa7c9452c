"""From files to stored trials: finding, reading, refusing and storing logs, and skipping known ones."""
