"""REST interface: routes, responses, formats of samples, and theory computed in a separate process."""
