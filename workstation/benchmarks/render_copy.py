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
from workstation.benchmarks.render_bounds import UNBOUNDED, at_most
from workstation.benchmarks.render_scenes import RenderedScene

_WIDTH = 160  # of the photographs
_SCAN_SIGMA_MM = 0.01
_PAPER = 26  # bytes per texel
_ERRORS = ("uncertainty", "reflectance-quality")


def copy_records(scene: RenderedScene) -> list[Record]:
    """A fitted part of the painting: its files, and what they lose of photographs it has not seen.

    Size and loss are of the same copy, fitted to noisy photographs and heights. Its standard
    errors, of which the paper's copy has none, have a figure of their own. The whole painting's
    maps are those of its pigments, without noise.
    """
    trial = PaintingTrial.of(PaintedScene.of(width=_WIDTH))
    fitted = trial.fit(copy=trial.scene.copy(height_sigma_mm=_SCAN_SIGMA_MM))[0]
    sizes, stored = _stored(fitted, exact_maps=False)
    exact, _ = _stored(fitted, exact_maps=True)
    errors = {name: sizes.pop(name) for name in _ERRORS if name in sizes}
    wanted, found = (pooled_psnr_db(trial.judged(copy)) for copy in (fitted, stored))
    painting, _ = _stored(scene.copy, exact_maps=False)
    return [
        at_most(
            "copy.bytes_per_texel",
            *(sum(sizes.values()), "B", 10),
            f"{_listed(sizes)}; with standard errors {sum((sizes | errors).values()):.1f}, and "
            f"{sum(exact.values()):.1f} with every bit; the paper's {_PAPER}",
        ),
        at_most(
            "copy.standard_errors_bytes_per_texel",
            *(sum(errors.values()), "B", UNBOUNDED, _listed(errors)),
        ),
        at_most(
            "copy.loss_db",
            *(wanted - found, "dB", 0.1),
            f"{found:.2f} dB of {len(trial.kept_out)} photographs that the fit has not seen, "
            f"{wanted:.2f} dB by float maps",
            runs=len(trial.kept_out),
        ),
        at_most(
            "copy.noiseless_bytes_per_texel",
            *(sum(painting.values()), "B", UNBOUNDED),
            f"the whole painting, of true maps; {_listed(painting)}",
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
