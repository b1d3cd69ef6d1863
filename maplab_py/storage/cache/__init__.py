"""Cache of map columns."""
