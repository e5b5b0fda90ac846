"""Acquisition: plans, patterns and their decoding, and the session on disk."""
