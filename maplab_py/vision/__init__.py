"""Recognising places: binary descriptors, their projection and index, and absolute camera pose."""
