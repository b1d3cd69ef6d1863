"""The scene in browsers: the only room that knows viser."""
