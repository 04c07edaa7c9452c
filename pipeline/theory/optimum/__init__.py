"""The (K, B) of smallest cost, curves of best damping, rules of thumb."""
