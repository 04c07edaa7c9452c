"""Take in log files as stored trials.

Logs are found, read and checked. Known logs are skipped, and new logs are stored or refused.
"""
