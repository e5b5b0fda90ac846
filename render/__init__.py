"""Rendering of digital copies through pyrender."""
