"""Lines of commands and where they come from: program arguments, scripts, batch files, aliases."""
