"""The sampled, delayed loop: the one definition of it, and the exact motion over a sample."""
