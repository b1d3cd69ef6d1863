"""Summary maps: a map reduced to what localisation needs."""
