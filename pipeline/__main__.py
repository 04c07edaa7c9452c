"""`python -m pipeline`: the command line, for when the console script is not on the path."""

from pipeline.shell.cli import run

run()
