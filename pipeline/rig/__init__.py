"""From the wall that is wanted to the rig that renders it."""
