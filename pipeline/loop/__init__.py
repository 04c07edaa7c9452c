"""Definition of the sampled, delayed loop, and of the exact motion over a sampling interval."""
