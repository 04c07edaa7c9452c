"""What a log's command is beside what the wall law commands: each departure has a name, or none, never a guess."""
