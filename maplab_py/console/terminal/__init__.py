"""Terminal: reports, progress, questions, Ctrl-C."""
