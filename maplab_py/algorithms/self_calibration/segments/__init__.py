"""Motion segments: splitting, selection, the database and its file."""
