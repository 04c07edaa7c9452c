"""The public Python interface behind ``import pipeline``: results of the other folders as data frames in SI."""
