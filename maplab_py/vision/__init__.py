"""Place recognition: binary descriptors, their projection and index, and absolute pose."""
