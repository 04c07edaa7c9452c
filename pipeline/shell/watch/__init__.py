"""Keeps reports current while logs arrive."""
