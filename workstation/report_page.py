"""Pages of reports: one HTML file each, that asks for nothing outside itself."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from acquisition.atomic_files import write_bytes

_UNITS = "mm|µm|px|texels|°|dB|1/sr|ms|s|min|MB|%"


@dataclass(frozen=True)
class Picture:
    """A PNG or JPEG picture and what it shows; whether it takes the width of the page."""

    caption: str
    content: bytes
    wide: bool = False

    @property
    def source(self) -> str:
        """Address that holds the picture itself."""
        kind = "jpeg" if self.content.startswith(b"\xff\xd8") else "png"
        return f"data:image/{kind};base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True)
class Fold:
    """Pictures that are shown when they are asked for, and in print; what asks for them."""

    title: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Comparison:
    """Two pictures of one size, laid over one another and parted by a slider."""

    caption: str
    left: Picture
    right: Picture


@dataclass(frozen=True)
class Table:
    """Rows of texts, the first of each naming it; a heading if there is one."""

    rows: tuple[tuple[str, ...], ...]
    heading: tuple[str, ...] = ()


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Attributes
    ----------
    title : str
    text : str
    tables : tuple of Table
    comparisons : tuple of Comparison
    pictures : tuple of Picture
    fold : Fold or None
        Below the pictures.
    small : bool
        Whether the pictures stand close together.
    """

    title: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    comparisons: tuple[Comparison, ...] = ()
    pictures: tuple[Picture, ...] = ()
    fold: Fold | None = None
    small: bool = False

    @property
    def anchor(self) -> str:
        """Name of the part in the page's addresses."""
        return anchor(self.title)


def anchor(title: str) -> str:
    """Name that a part of a page has in its addresses."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())


def write_page(
    path: Path,
    *,
    title: str,
    summary: str,
    sections: tuple[Section, ...],
    warnings: tuple[str, ...] = (),
) -> None:
    """Write a report's page, whole or not at all.

    Parameters
    ----------
    path : Path
    title : str
    summary : str
        A sentence or two below the title.
    sections : tuple of Section
    warnings : tuple of str
        Shown before the sections.
    """
    page = (
        page_templates()
        .get_template("session.html")
        .render(title=title, summary=summary, sections=sections, warnings=warnings)
    )
    write_bytes(path, page.encode())


def page_templates() -> Environment:
    """The templates that pages are made from."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["typeset"] = typeset
    return environment


def typeset(text: object) -> Markup:
    """A text as HTML, its numbers and symbols as they are printed.

    Negative numbers get a minus sign and zero none, digits from 10 000 on stand in threes, units
    stay with their numbers, and indices of symbols are lowered. Names of many parts may be broken
    between them.
    """
    said = str(escape(text))
    said = re.sub(r"(?<![\w.)])-(?=\.?\d)", "\N{MINUS SIGN}", said)
    said = re.sub(r"\N{MINUS SIGN}(0(\.0+)?)(?![\d.e])", r"\1", said)
    said = re.sub(
        r"(?<![\w.#])[1-9]\d{4,}(?![\w.])",
        lambda number: f"{int(number[0]):,}".replace(",", "\N{NARROW NO-BREAK SPACE}"),
        said,
    )
    said = re.sub(rf"(?<=\d) (?=(?:{_UNITS})(?!\w))", "\N{NO-BREAK SPACE}", said)
    said = re.sub(r"(?<![\w.])(?:([ρfc])_([dsxy])|(δ)(0))(?!\w)", _lowered, said)
    return Markup(re.sub(r"(?<=[a-z0-9][a-z0-9][._])(?=[a-z])", "<wbr>", said))


def _lowered(symbol: re.Match[str]) -> str:
    letter, index = filter(None, symbol.groups())
    return f"{letter}<sub>{index}</sub>"


def figure_png(figure: Figure, *, dpi: float) -> bytes:
    """A figure as PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
