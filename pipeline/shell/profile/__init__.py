"""Log profiles: drafted, tried on samples, warned of."""
