"""Cells of a map: parts by position that overlap."""
