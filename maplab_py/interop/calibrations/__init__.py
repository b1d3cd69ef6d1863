"""Readers of calibrations by family of programs; `interop.calibration_import` chooses among them."""
