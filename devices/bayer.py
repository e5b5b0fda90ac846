"""Colour mosaics of sensors; without numpy, so that the command line can name them at once."""

from __future__ import annotations

from enum import StrEnum


class BayerPattern(StrEnum):
    """Colours of a mosaic's first two rows, row by row."""

    RGGB = "RGGB"
    GRBG = "GRBG"
    GBRG = "GBRG"
    BGGR = "BGGR"
