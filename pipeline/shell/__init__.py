"""The command line, and the commands that drive all else."""
