"""Planning of the next walls (K, B): a model proposes, verdicts of trials decide."""
