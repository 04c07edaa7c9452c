"""The sampled, delayed loop: its only definition, and the exact motion over a sampling interval."""
