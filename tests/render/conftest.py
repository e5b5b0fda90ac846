from __future__ import annotations

from collections.abc import Iterator

import pytest

from render.painter import Painter


@pytest.fixture(scope="module")
def painter() -> Iterator[Painter]:
    with Painter(supersampling=1) as painter:
        yield painter
