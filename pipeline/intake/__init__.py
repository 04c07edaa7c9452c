"""From files to stored trials: what is found, read, refused, stored, and what a second run need not do."""
