"""The map in the browser. A scene is plain data built from a map; only `display/` talks to viser."""
