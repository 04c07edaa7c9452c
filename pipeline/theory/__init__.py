"""The sampled, delayed loop in closed form; it knows nothing of logs."""
