"""Modules of commands, one for each group. Each command parses arguments, calls functions and prints the result."""
