"""The copy on disk: bytes per texel, and what rounding its maps loses of held-out photographs."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from fitting.copy_files import read_copy, write_copy
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.held_out import pooled_psnr_db
from workstation.benchmark_records import Record
from workstation.benchmarks.painted_photographs import PaintedScene
from workstation.benchmarks.painted_reflectance import PaintingTrial
from workstation.benchmarks.render_bounds import at_most
from workstation.benchmarks.render_scenes import RenderedScene

_WIDTH = 160  # of the photographs
_SCAN_SIGMA_MM = 0.01
_PAPER = 26  # bytes per texel
_ERRORS = ("uncertainty", "reflectance-quality")


def copy_records(scene: RenderedScene) -> list[Record]:
    """The whole oil painting's files; and a fitted part's, beside photographs kept out of its fit.

    The painting's maps are those of its pigments, without noise. The part's are fitted to noisy
    photographs and heights, and their standard errors are stored with them.
    """
    sizes, _ = _stored(scene.copy, exact_maps=False)
    exact, _ = _stored(scene.copy, exact_maps=True)
    records = [
        at_most(
            "copy.bytes_per_texel",
            *(sum(sizes.values()), "B", 10),
            f"{_listed(sizes)}; {sum(exact.values()):.1f} with every bit; the paper's {_PAPER}",
        )
    ]
    trial = PaintingTrial.of(PaintedScene.of(width=_WIDTH))
    fitted = trial.fit(copy=trial.scene.copy(height_sigma_mm=_SCAN_SIGMA_MM))[0]
    sizes, stored = _stored(fitted, exact_maps=False)
    exact, _ = _stored(fitted, exact_maps=True)
    shown = {name: size for name, size in sizes.items() if name not in _ERRORS}
    wanted, found = (pooled_psnr_db(trial.judged(copy)) for copy in (fitted, stored))
    return [
        *records,
        at_most(
            "copy.fitted_bytes_per_texel",
            *(sum(sizes.values()), "B", _PAPER),
            f"{_listed(sizes)}; {sum(shown.values()):.1f} without standard errors, as the paper's "
            f"{_PAPER}; {sum(exact.values()):.1f} with every bit",
        ),
        at_most(
            "copy.loss_db",
            *(wanted - found, "dB", 0.1),
            f"{found:.2f} dB of {len(trial.kept_out)} photographs that the fit has not seen, "
            f"{wanted:.2f} dB by float maps",
            runs=len(trial.kept_out),
        ),
    ]


def _stored(copy: DigitalCopy, *, exact_maps: bool) -> tuple[dict[str, float], DigitalCopy]:
    """Bytes per texel by file, and what is read from them."""
    with TemporaryDirectory() as folder:
        place = Path(folder) / "copy"
        write_copy(copy, place, exact_maps=exact_maps)
        texels = copy.height_field.height.size
        sizes = {file.stem: file.stat().st_size / texels for file in sorted(place.iterdir())}
        return sizes, read_copy(place)


def _listed(sizes: dict[str, float]) -> str:
    return ", ".join(f"{name} {size:.2f}" for name, size in sizes.items())
