from __future__ import annotations

import base64
import json
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import A4_MM, LETTER_MM, check_page
from impasto_command import impasto
from synthetic_copy import make_copy

from acquisition.contact_sheet import draw_contact_sheet, draw_contact_sheets
from acquisition.session import Session
from devices.simulated.rig import demo_rig
from fitting.copy_files import write_copy
from fitting.digital_copy import ReflectanceMaps
from workstation.copy_writing import HELD_OUT_FILE, HELD_OUT_FOLDER
from workstation.demonstration import record_simulated_scan
from workstation.report_maps import draw_map, shaded_relief
from workstation.report_page import Comparison, Fold, Picture, Section, typeset, write_page
from workstation.session_report import PARTS, write_session_report

ERRORS = {
    "height_noise": {"observed_mm": 0.03, "predicted_mm": 0.02, "samples": 9},
    "height_sigma_mm": 0.01,
    "calibration_uncertainty": {"height_sigma_mm": 0.004},
    "heldout_psnr_db": 31.25,
    "heldout_noise_psnr_db": 45.5,
    "canvas_shape": {
        f"{n}{s}_mm": 0.1 for n in ("bow_x", "bow_y", "twist") for s in ("", "_sigma")
    },
}


RUN = {
    "quality": "draft",
    "expected_seconds": {"decoding": 4.0},
    "stages": [
        {"name": "decoding", "seconds": 0.1, "skipped": True, "saved_s": 4.2, "peak_mb": 99.0}
    ],
    "rays": {"tested": 12, "cast": 9, "blocked": 1},
}


def bumpy():
    y, x = np.mgrid[:60, :80]
    hills = np.maximum(0, np.sin(x / 6) * np.sin(y / 5) - 0.5) * 3
    mask = np.ones((60, 80), bool)
    mask[10:14, 20:30] = False
    return make_copy(hills, mask=mask)


class Page(HTMLParser):
    """What a page is made of."""

    def __init__(self, path):
        super().__init__()
        self.pictures, self.text, self.addresses, self.anchors = [], [], [], set()
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "img":
            self.pictures.append((given["alt"], given["src"]))
        self.addresses += [given[name] for name in ("src", "href") if name in given]
        self.anchors.add(given.get("id"))

    def handle_data(self, data):
        self.text.append(data)

    @property
    def said(self):
        """Its text as it was before it was typeset for lines to break well."""
        return "".join(self.text).replace("\xa0", " ")

    def picture(self, alt):
        source = next(source for name, source in self.pictures if name == alt)
        content = base64.b64decode(source.partition(",")[2])
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scan") / "session"
    record_simulated_scan(demo_rig(camera_width=64), folder)
    return folder


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("copy") / "copy"
    made = bumpy()
    shape = made.height_field.shape
    maps = ReflectanceMaps(
        np.full((*shape, 3), 0.1, np.float32),
        np.full((*shape, 3), 0.2, np.float32),
        np.full((*shape, 4), 2.0, np.float32),
    )
    provenance = {
        "software": "impasto 9",
        "source": "<somewhere>",
        "errors": ERRORS,
        "warnings": ["two canvases & one frame"],
        "parameters": {"surface": {"pitch_mm": None}},
        "calibration": "that of another folder",
    }
    write_copy(replace(made, reflectance=maps, provenance=provenance), folder)
    (folder / HELD_OUT_FOLDER).mkdir()
    for kind in ("measured", "rendered"):
        picture = np.full((60, 80, 3), 90, np.uint8)
        cv2.imwrite(str(folder / HELD_OUT_FOLDER / f"front-0003-{kind}.png"), picture)
    row = {"name": "front-0003", "psnr_db": 31.4, "delta_e": 2.5}
    row |= {"noise_psnr_db": 44.0, "noise_delta_e": 0.8}
    (folder / HELD_OUT_FILE).write_text(json.dumps([row]))
    return folder


@dataclass(frozen=True)
class Report:
    page: Path
    figures: dict
    parts: list


@pytest.fixture(scope="module")
def report(copy, session, tmp_path_factory):
    page, parts = tmp_path_factory.mktemp("report") / "r.html", []
    figures = write_session_report(
        copy,
        page,
        session=Session.open(session),
        photographs=Session.open(session),
        run=RUN,
        begin=parts.append,
    )
    return Report(page, figures, parts)


def test_the_page_tells_everything_and_asks_for_nothing(report, session):
    assert len(report.parts) == PARTS
    page = Page(report.page)
    assert all(a.startswith(("data:", "#")) for a in page.addresses)
    assert {a[1:] for a in page.addresses if a.startswith("#")} <= page.anchors
    text = page.said
    wanted = ("two canvases & one frame", "<somewhere>", "1.50", "30.0 µm", "20.0 µm", "4.0 µm")
    wanted += ("31.2 dB", "45.5 dB")
    for word in (
        *wanted,
        "4.2 s spared",
        "3 of 12",
        "by default from the data",
        "a calibration that is not the session's own and not at hand",
        Session.open(session).digest,
    ):
        assert word in text, word
    assert "Reflectance" in report.figures["sections"]
    for alt, _ in page.pictures:
        assert alt
        assert page.picture(alt) is not None
    assert page.picture("inshot-front").shape == (480, 640, 3)
    assert page.picture("inshot-front").std() > 1


def test_the_page_is_whole_and_reachable_in_a_browser(browser, report):
    check_page(browser, report.page)


def test_sheets_that_fit_a_page_show_every_frame_in_the_order_of_the_plan(session):
    opened = Session.open(session)
    whole, figures = draw_contact_sheet(opened)
    sheets, again = draw_contact_sheets(opened, columns=4, rows=3)
    assert again == figures
    assert len(sheets) == -(-len(opened.plan.frames) // 12)
    # A place is a thumbnail of 160 × 120 with three lines below it and a gap of 6 around it.
    down, across = 120 + 3 * 13 + 6, 160 + 6
    for number in range(len(opened.plan.frames)):
        seen = []
        for sheet, n in ((whole, number), (sheets[number // 12], number % 12)):
            row, col = divmod(n, sheet.shape[1] // across)
            top, left = 6 + row * down, 6 + col * across
            seen.append(sheet[top : top + down - 6, left : left + across - 6])
        np.testing.assert_array_equal(*seen)


def test_a_copy_alone_has_a_page_too(tmp_path):
    write_copy(bumpy(), tmp_path / "copy")
    figures = write_session_report(tmp_path / "copy", tmp_path / "r.html")
    assert "What was captured" not in figures["sections"]
    assert "Reflectance" not in figures["sections"]


def test_the_command_writes_page_and_figures(copy, tmp_path):
    page, figures = tmp_path / "r.html", tmp_path / "f.json"
    done = impasto("report", copy, "--out", page, "--json", figures)
    assert done.returncode == 0, done.stderr
    assert page.is_file()
    assert json.loads(figures.read_text())["errors"] == ERRORS
    missing = impasto("report", copy, "--out", tmp_path / "nowhere" / "r.html")
    assert missing.returncode == 3
    assert "make it first" in missing.stderr


def test_maps_keep_gaps_empty_and_end_their_colours_as_asked():
    copy = bumpy()
    field = copy.height_field
    values = field.height.astype(np.float64)
    values[~field.mask] = np.nan
    drawn = cv2.imdecode(np.frombuffer(draw_map(copy, values, scale="height, mm"), np.uint8), 1)
    assert drawn.shape[1] > 600
    # One outlier takes all contrast from the rest, unless the colours end before it.
    values[30, 40] = 1e6
    contrast = []
    for limits in ((1.0, 99.0), (0.0, 100.0)):
        content = draw_map(copy, values, limits=limits)
        drawn = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        inside = drawn[150:250, 300:400]
        contrast.append(inside.std(axis=(0, 1)).max())
    assert contrast[0] > 3 * contrast[1]


def test_relief_is_lit_from_the_upper_left():
    copy = bumpy()
    field = copy.height_field
    rows, cols = np.mgrid[: field.shape[0], : field.shape[1]]
    towards = replace(field, height=(0.1 * (cols + rows)).astype(np.float32))
    away = replace(field, height=(-0.1 * (cols + rows)).astype(np.float32))
    shades = [shaded_relief(replace(copy, height_field=f)).mean() for f in (towards, away)]
    # Heights that rise to the lower right face the upper left.
    assert shades[0] > shades[1] + 0.1


def test_a_slider_parts_two_pictures_and_can_be_moved_by_keys(browser, tmp_path):
    white = cv2.imencode(".png", np.full((60, 80, 3), 255, np.uint8))[1].tobytes()
    black = cv2.imencode(".png", np.zeros((60, 80, 3), np.uint8))[1].tobytes()
    pair = Comparison("both", Picture("photograph", white), Picture("render", black))
    section = Section("Held out", comparisons=(pair,))
    write_page(tmp_path / "p.html", title="t", summary="s", sections=(section,))
    browser.open(tmp_path / "p.html", width=400)
    for turns, parted in ((0, 0.5), (20, 0.7)):
        browser.evaluate("document.querySelector('input').focus()")
        for _ in range(turns):
            browser.press("ArrowRight", 39)
        seen = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
        # White to the left of where the slider is, black to its right.
        row = seen[np.flatnonzero((seen[:, 330] < 5) & (seen[:, 100] > 250))[20]]
        left, right = np.flatnonzero(row < 5)[[0, -1]]
        assert (left - 16) / (right + 1 - 16) == pytest.approx(parted, abs=0.01)


def test_folded_pictures_are_shown_when_they_are_asked_for_and_in_print(browser, tmp_path):
    # As large as contact sheets, of which two go on a sheet of paper.
    grey = cv2.imencode(".png", np.full((831, 1334), 90, np.uint8))[1].tobytes()
    names = ["first", "second", "third", "fourth", "fifth"]
    first, *others = (Picture(name, grey, wide=True) for name in names)
    section = Section("Sheets", pictures=(first,), fold=Fold("The others (4)", tuple(others)))
    write_page(tmp_path / "p.html", title="t", summary="s", sections=(section,))
    browser.open(tmp_path / "p.html", width=400)
    shown = "[...document.images].filter(one => one.checkVisibility()).map(one => one.alt)"
    assert browser.evaluate(shown) == names[:1]
    for paper_mm in (A4_MM, LETTER_MM):
        assert browser.pictures_printed(paper_mm=paper_mm) == [1, 2, 2]
    browser.evaluate("document.querySelector('summary').click()")
    assert browser.evaluate(shown) == names
    check_page(browser, tmp_path / "p.html")


@pytest.mark.parametrize(
    ("written", "printed"),
    [
        ("-0.68 and 1.4 mm", "−0.68 and 1.4\xa0mm"),
        ("-0.00 µm", "0.00\xa0µm"),
        ("59571 people of 12345.67", "59\u202f571 people of 12345.67"),
        ("front-0004 on 2026-11-30, 1e-05", "front-0004 on 2026-11-30, 1e-05"),
        ("π ρ_d, δ0, surface.c_x", "π ρ<sub>d</sub>, δ<sub>0</sub>, surface.<wbr>c_x"),
        ("relief.delta0_mm is 1.5 mm.", "relief.<wbr>delta0_<wbr>mm is 1.5\xa0mm."),
        ("<b> & '", "&lt;b&gt; &amp; &#39;"),
    ],
)
def test_numbers_and_symbols_are_typeset_and_names_left_alone(written, printed):
    assert str(typeset(written)) == printed


FAULTS = {
    "it scrolls sideways": "<p style='width: 2000px'>wide</p>",
    "in letters": (
        "<table><td style='font: 16px/20px serif; overflow-wrap: anywhere; max-width: 9px'>letters"
    ),
    "a picture without a name": "<img alt='' src='DATA'>",
    "it is faint": "<p style='color: #ccc'>faint</p>",
    "wrong": "<script>console.error('wrong')</script>",
    "asked for http://127.0.0.1:9/x.png": "<img alt='elsewhere' src='http://127.0.0.1:9/x.png'>",
    "control 0 does not show the focus": "<button style='outline: none'>unseen</button>",
    "control 0 is not reached": "<button tabindex='-1'>unreached</button>",
    "control 0 opens nothing": "<details><summary onclick='return false'>shut</summary></details>",
    "a figure may be parted": "<figure style='break-inside: auto'>parted</figure>",
    "a figure is longer than a sheet": "<figure style='height: 1100px'>long</figure>",
    "a picture is cut": "<img alt='long' style='width: 9px; height: 1500px' src='DATA'>",
    "or folded away": "<details><summary>more</summary><img alt='grey' src='DATA'></details>",
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_a_page_is_noticed(browser, tmp_path, name):
    write_faulty(tmp_path / "faulty.html", FAULTS[name])
    with pytest.raises(AssertionError, match=name):
        check_page(browser, tmp_path / "faulty.html")


def test_a_page_without_faults_is_let_through(browser, tmp_path):
    write_faulty(tmp_path / "good.html", "<a href='#x'>there</a><img alt='grey' src='DATA'>")
    check_page(browser, tmp_path / "good.html")


def write_faulty(path, fault):
    grey = Picture("grey", cv2.imencode(".png", np.full((9, 9), 90, np.uint8))[1].tobytes())
    style = "figure { break-inside: avoid } :focus-visible { outline: 2px solid }"
    page = f"<!doctype html><style>{style}</style>{fault.replace('DATA', grey.source)}"
    path.write_text(page)
