"""The public Python surface behind ``import pipeline``: data frames in SI of what the other folders compute."""
