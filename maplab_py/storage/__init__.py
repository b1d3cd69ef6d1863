"""Native map files: reading, writing, atomic saving, resources."""
