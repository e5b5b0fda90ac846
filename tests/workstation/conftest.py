from __future__ import annotations

from collections.abc import Iterator

import pytest
from browser import Browser, headless_browser


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A browser to look at pages with."""
    with headless_browser() as started:
        yield started
