"""Place recognition: descriptors, their projection and index, and absolute pose."""
