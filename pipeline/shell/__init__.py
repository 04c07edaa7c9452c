"""The command line, its commands, and the modules that only commands use."""
