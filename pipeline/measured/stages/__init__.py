"""What an experiment stores: what each stage makes, the table of them, and what stores and reuses them."""
