"""Ground that all else stands on: errors, units, files on the disk, hashes."""
