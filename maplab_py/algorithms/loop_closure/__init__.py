"""Loop closure: which vertices saw the same place, verified, and what follows for the map."""
