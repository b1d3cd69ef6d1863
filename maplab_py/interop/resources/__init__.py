"""Images, depth maps and point clouds of other programs as resources of a map, and back."""
