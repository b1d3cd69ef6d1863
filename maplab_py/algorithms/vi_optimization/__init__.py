"""Visual-inertial batch optimisation of a map (optvi) and its visual-only variant (optv)."""
