"""Folders that tests read from."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
"""Folder of the project."""

SHARED = ROOT.parent / "shared"
"""Reference data and real logs beside the project; tests that use it are skipped where it is missing."""
