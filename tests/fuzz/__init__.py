"""Random input, guided by coverage, for every reader: `python -m tests.fuzz READER` (docs in `readers`)."""
