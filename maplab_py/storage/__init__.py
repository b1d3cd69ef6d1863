"""Native map folders: load, save, resources. `native` is the public entry."""
