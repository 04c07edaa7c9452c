"""Run the command line with `python -m pipeline`, for example if the console script is not on the path."""

from pipeline.shell.cli import run

run()
