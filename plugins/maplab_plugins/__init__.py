"""The built-in commands, one module per plugin, on the public plugin surface only."""
