"""How certain a calibration is, and how much a segment contributes to it."""
