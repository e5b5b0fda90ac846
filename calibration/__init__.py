"""Calibration: lens models, the rig's geometry, and the files they come from."""
