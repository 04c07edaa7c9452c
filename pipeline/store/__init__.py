"""Stored trials and stages in `processed/`, which is a folder or a bucket, and corrections of trials."""
