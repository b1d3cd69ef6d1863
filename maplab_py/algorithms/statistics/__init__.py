"""Statistics of a map: distributions and memory."""
