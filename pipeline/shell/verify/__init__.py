"""Every number of a report computed anew."""
