"""REST: routes, their answers, forms of samples, theory in a separate process."""
