"""Studies of the self-calibration on simulated sessions: `python -m studies --help`."""
