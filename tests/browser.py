"""Pages as a browser shows them: headless Chromium, driven through a pipe; what a page must be.

The pipe speaks the DevTools protocol: https://chromedevtools.github.io/devtools-protocol/
"""

from __future__ import annotations

import base64
import json
import os
import re
import select
import shutil
import signal
import subprocess
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

_OPTIONS = (
    "--headless --no-sandbox --disable-gpu --disable-dev-shm-usage --hide-scrollbars "
    "--no-first-run --disable-background-networking --disable-component-update "
    "--disable-extensions --remote-debugging-pipe"
)
_ANSWER_S = 60.0
WIDTHS_PX = (400, 700, 1600)
A4_MM, LETTER_MM = (210.0, 297.0), (215.9, 279.4)
# What A4 leaves between the margins that the pages ask for, in CSS pixels.
_PAPER_PX = tuple((side_mm - 2 * 15) / 25.4 * 96 for side_mm in A4_MM)
_FIT_FOR_EYES = 4.5  # contrast of small text, by WCAG 2.2, 1.4.3


class Browser:
    """One tab of a headless Chromium.

    Attributes
    ----------
    events : list of dict
        What the tab has told since the page was opened.
    """

    def __init__(self, to: int, back: int) -> None:
        self._to, self._back = to, back
        self._unread = b""
        self._number = 0
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        answer = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = answer["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """Have a command done, and return what it gives."""
        self._number += 1
        command = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            command["sessionId"] = self._session
        os.write(self._to, json.dumps(command).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def open(self, page: Path, *, width: int) -> None:
        """Open a page in a window of a width, and wait until all of it is there."""
        self.events.clear()
        self.call("Emulation.setEmulatedMedia", media="")
        self.resize(width, 900)
        self.call("Page.navigate", url=page.absolute().as_uri())
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())

    def resize(self, width: float, height: float) -> None:
        """Give the window another size, CSS pixels."""
        size = {"width": round(width), "height": round(height)}
        self.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1, mobile=False)

    def evaluate(self, expression: str) -> Any:
        """Value of an expression of JavaScript."""
        done = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def press(self, key: str, code: int) -> None:
        """Press a key and let it go."""
        for kind in ("rawKeyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code
            )

    def screenshot(self) -> bytes:
        """What is in the window, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def pictures_printed(self, *, paper_mm: tuple[float, float] = A4_MM) -> list[int]:
        """How many pictures are drawn on each sheet that has some, of the page as it is printed."""
        size = {"paperWidth": paper_mm[0] / 25.4, "paperHeight": paper_mm[1] / 25.4}
        pdf = self.call("Page.printToPDF", **size, preferCSSPageSize=True)["data"]
        drawn = (re.findall(rb"/X\d+ Do\b", stream) for stream in _streams(base64.b64decode(pdf)))
        return [len(pictures) for pictures in drawn if pictures]

    def told(self) -> list[str]:
        """Messages of the page's console, and what the page asked of others."""
        said = []
        for event in self.events:
            method, about = event.get("method"), event.get("params", {})
            if method in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
                said.append(json.dumps(about))
            elif method == "Network.requestWillBeSent":
                address = about["request"]["url"]
                if not address.startswith("data:") and about["type"] != "Document":
                    said.append(f"asked for {address}")
        return said

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            answering, _, _ = select.select([self._back], [], [], _ANSWER_S)
            assert answering, "Chromium does not answer"
            read = os.read(self._back, 1 << 20)
            assert read, "Chromium has ended"
            self._unread += read
        message, _, self._unread = self._unread.partition(b"\0")
        return json.loads(message)


@contextmanager
def headless_browser() -> Iterator[Browser]:
    """Run Chromium while the block runs; skip where there is none."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("Chromium is not installed (apt install chromium)")
    commands, to = os.pipe()
    back, answers = os.pipe()
    # Processes of a browser that is killed may write into its profile for a moment.
    with TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        # Commands are read from file 3, answers written to file 4.
        process = subprocess.Popen(
            [
                *("bash", "-c", f'exec "$@" 3<&{commands} 4>&{answers}', "bash"),
                *(chromium, *_OPTIONS.split(), f"--user-data-dir={profile}/profile", "about:blank"),
            ],
            pass_fds=(commands, answers),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(commands)
        os.close(answers)
        try:
            yield Browser(to, back)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            os.close(to)
            os.close(back)


def check_page(browser: Browser, page: Path) -> None:
    """Hold a page against what every page must be: whole at any width, reachable, printable."""
    browser.open(page, width=WIDTHS_PX[0])
    if _set_folds(browser, opened=True):
        _check_widths(browser, page)
    _set_folds(browser, opened=False)
    _check_widths(browser, page)
    _check_keyboard(browser)
    _check_print(browser)


def _set_folds(browser: Browser, *, opened: bool) -> int:
    """Open or shut every fold; how many there are."""
    browser.evaluate("window.folds = document.querySelectorAll('details')")
    browser.evaluate(f"folds.forEach(fold => {{ fold.open = {json.dumps(opened)}; }})")
    return int(browser.evaluate("folds.length"))


def _check_widths(browser: Browser, page: Path) -> None:
    for width in WIDTHS_PX:
        browser.resize(width, 900)
        faults = browser.told() + browser.evaluate(_NOT_SHOWN) + browser.evaluate(_FAINT)
        assert not faults, f"{page.name} at {width} pixels: {'; '.join(faults)}"


def _check_keyboard(browser: Browser) -> None:
    """Every control takes the focus, in the page's order, and shows it; keys work each."""
    controls = browser.evaluate(f"window.controls = {_CONTROLS}; controls.length")
    for number in range(controls):
        browser.press("Tab", 9)
        reached = browser.evaluate("controls.indexOf(document.activeElement)")
        assert reached == number, f"control {number} is not reached"
        shown = browser.evaluate(_FOCUS_SHOWN)
        assert shown, f"control {number} does not show the focus"
        if browser.evaluate("document.activeElement.type") == "range":
            before = browser.evaluate(_PARTED_AT)
            browser.press("ArrowRight", 39)
            after = browser.evaluate(_PARTED_AT)
            moved = [before[0] + 1, f"{before[0] + 1}%"]
            assert after == moved, f"control {number} does not move the pictures"
        if browser.evaluate("document.activeElement.tagName") == "SUMMARY":
            before = browser.evaluate(_OPEN)
            browser.press(" ", 32)
            assert browser.evaluate(_OPEN) != before, f"control {number} opens nothing"


def _check_print(browser: Browser) -> None:
    """No figure is folded away, cut by the end of a sheet, or parted from its caption."""
    _set_folds(browser, opened=False)
    browser.resize(*_PAPER_PX)
    browser.call("Emulation.setEmulatedMedia", media="print")
    faults, figures = browser.evaluate(_NOT_SHOWN), browser.evaluate(_FIGURES)
    browser.call("Emulation.setEmulatedMedia", media="")
    assert not faults, f"printed: {'; '.join(faults)}"
    for figure in figures:
        assert figure["kept"] == "avoid", "a figure may be parted"
        assert figure["height"] <= _PAPER_PX[1], "a figure is longer than a sheet"
    # A picture that goes over to another sheet is drawn on both.
    drawn = sum(browser.pictures_printed())
    assert drawn == browser.evaluate("document.images.length"), "a picture is cut, or folded away"


def _streams(pdf: bytes) -> Iterator[bytes]:
    for found in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL):
        try:
            yield zlib.decompress(found[1])
        except zlib.error:
            continue  # a picture or a font


_CONTROLS = "[...document.querySelectorAll('a[href], button, input, select, summary, textarea')]"
_OPEN = "document.activeElement.parentElement.open"
_FOCUS_SHOWN = """(() => {
  const style = getComputedStyle(document.activeElement);
  return style.outlineStyle === 'solid' && parseFloat(style.outlineWidth) >= 2;
})()"""
_PARTED_AT = """(() => {
  const slider = document.activeElement, pictures = slider.previousElementSibling;
  return [Number(slider.value), getComputedStyle(pictures).getPropertyValue('--at').trim()];
})()"""
_FIGURES = """[...document.querySelectorAll('figure')].map(figure => ({
  kept: getComputedStyle(figure).breakInside, height: figure.getBoundingClientRect().height,
}))"""
# Pictures that are missing or without a name, what sticks out of the window, and cells that are so
# narrow that words fall apart.
_NOT_SHOWN = """(() => {
  const found = [], width = innerWidth;
  if (document.documentElement.scrollWidth > width) found.push('it scrolls sideways');
  for (const picture of document.images) {
    if (!picture.naturalWidth) found.push(`no picture ${picture.alt}`);
    if (!picture.alt.trim()) found.push('a picture without a name');
  }
  for (const one of document.body.querySelectorAll('*')) {
    const box = one.getBoundingClientRect();
    const name = `${one.tagName} ${one.textContent.slice(0, 60)}`;
    if (box.left < 0 || box.right > width) found.push(`it sticks out: ${name}`);
    if (one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).overflowX !== 'visible')
      found.push(`it is cut: ${name}`);
  }
  for (const cell of document.querySelectorAll('td, th')) {
    const range = document.createRange();
    range.selectNodeContents(cell);
    const line = parseFloat(getComputedStyle(cell).lineHeight);
    const lines = range.getBoundingClientRect().height / line;
    if (lines > 1.5 + cell.textContent.length / 5) found.push(`in letters: ${cell.textContent}`);
  }
  return found;
})()"""
_FAINT = """(() => {
  const parts = colour => colour.match(/[\\d.]+/g).map(Number);
  const light = colour => {
    const [r, g, b] = parts(colour).slice(0, 3).map(c => c / 255).map(
      c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = one => {
    for (; one; one = one.parentElement) {
      const colour = getComputedStyle(one).backgroundColor, [, , , alpha = 1] = parts(colour);
      if (alpha > 0) return colour;
    }
    return 'rgb(255, 255, 255)';
  };
  return [...document.body.querySelectorAll('*')].filter(one => {
    if (![...one.childNodes].some(node => node.nodeType === 3 && node.data.trim())) return false;
    const both = [light(getComputedStyle(one).color), light(ground(one))];
    const [low, high] = both.sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05) < CONTRAST;
  }).map(one => `it is faint: ${one.textContent}`);
})()""".replace("CONTRAST", str(_FIT_FOR_EYES))
