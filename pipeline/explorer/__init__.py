"""The explorer: the theory of a loop as one page with sliders, computed by the page itself."""
