"""Features of the images of a map: extraction from its resources, and tracks of what was extracted."""
