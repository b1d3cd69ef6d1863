"""What the user sees and how a command is waited for: reports, progress, questions, Ctrl-C."""
