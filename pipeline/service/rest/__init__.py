"""REST: routes, what they answer, forms of samples, theory in a process of its own."""
