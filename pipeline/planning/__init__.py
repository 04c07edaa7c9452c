"""Planning of the next walls (K, B). A model proposes walls, and verdicts of trials decide."""
