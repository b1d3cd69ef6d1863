"""COLMAP models: reading, writing, and maps made of them."""
