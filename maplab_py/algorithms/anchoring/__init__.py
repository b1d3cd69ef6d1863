"""Anchoring: estimate unknown base frames of missions relative to known ones."""
