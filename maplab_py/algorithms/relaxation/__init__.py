"""Pose-graph relaxation: spread the corrections of loop closures over the trajectories."""
