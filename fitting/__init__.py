"""Fitting: range image, canvas, height field, relief boxes, and the digital copy."""
