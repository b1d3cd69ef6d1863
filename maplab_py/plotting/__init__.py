"""Figures of maps: arrays in, matplotlib figures out; no windows, no global state."""
