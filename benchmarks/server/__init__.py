"""The map server: growth with the size of the map, EuRoC's submaps, kills at random moments."""
