"""The explorer is a page with sliders for the theory of a loop. The page itself computes the theory."""
