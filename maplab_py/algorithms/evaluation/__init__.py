"""How far a trajectory is from the truth: absolute and relative pose errors."""
