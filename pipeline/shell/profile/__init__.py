"""Drafts of log profiles, profiles from options of the command line, and checks of profiles on sample logs."""
