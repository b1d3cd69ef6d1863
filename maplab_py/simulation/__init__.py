"""Visual-inertial sessions with known truth: motion, world, sensors, appearance, drift."""
