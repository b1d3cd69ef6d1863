"""Loop closure: place recognition, geometric verification, and landmark merging or edges."""
