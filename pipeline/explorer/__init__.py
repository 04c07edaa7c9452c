"""The explorer: a page with sliders for the theory of a loop. The theory is computed in the page itself."""
