"""REST interface: routes, answers, formats of samples, and theory computed in a separate process."""
