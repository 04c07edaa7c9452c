"""Stored trials and stages in `processed/`, a folder or a bucket: batches, their rows and samples, corrections."""
