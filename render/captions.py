"""Lines of text over a picture, in the font that pyrender brings."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from render.opengl import pyrender

_FONT = Path(pyrender.__file__).with_name("fonts") / "OpenSans-Regular.ttf"
_SIZE_PX, _LINE_PX, _PADDING_PX = 14, 21, 9
_INK, _SHADE = (255, 255, 255, 255), (0, 0, 0, 130)


def caption_picture(
    top: list[str], bottom: list[str], *, width: int, height: int
) -> NDArray[np.uint8]:
    """Light text on bands of shade at the top and the bottom of a picture.

    Returns
    -------
    (height, width, 4) uint8 array
        sRGB and opacity.
    """
    picture = Image.new("RGBA", (width, height))
    draw = ImageDraw.Draw(picture)
    for lines, at_top in ((top, True), (bottom, False)):
        if not lines:
            continue
        band = len(lines) * _LINE_PX + _PADDING_PX
        start = 0 if at_top else height - band
        draw.rectangle((0, start, width, start + band - 1), fill=_SHADE)
        for number, line in enumerate(lines):
            place = (_PADDING_PX, start + _PADDING_PX // 2 + number * _LINE_PX)
            draw.text(place, line, font=font(_SIZE_PX), fill=_INK)
    return np.array(picture)


@cache
def font(size_px: int) -> ImageFont.FreeTypeFont:
    """The font at a size."""
    return ImageFont.truetype(str(_FONT), size_px)
