"""What an experiment stores: one module a stage, and what stores and reuses them."""
