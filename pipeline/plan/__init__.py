"""Which walls (K, B) to try next: a model proposes, verdicts of trials decide."""
