"""Anchoring: find how missions of unknown base frame lie among the known ones."""
