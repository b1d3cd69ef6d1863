"""Algorithms: one module or folder per capability, VIMap -> VIMap."""
