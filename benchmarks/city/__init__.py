"""Missions of a city from raw maps to their joint optimum: `python -m benchmarks.city`."""
