"""How much of the torture piece a bracket of exposures decodes, of what light allows.

Optically decodable is what some exposure of the bracket's range could decode, frame period by frame
period: where the panel lights the surface, no fringe saturates, and its modulation, dimmed by the
projector's blur, stands out of the noise as decoding wants it. All of that is computed from the
scene itself, without noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import DecodingOptions, decode
from acquisition.patterns import Axis
from acquisition.plan import Metering, Plan, Purpose
from acquisition.recorded_frames import recording_of
from acquisition.recording import record_plan
from acquisition.scan import plan_scan, scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.replay import replay_rig
from devices.simulated.rig import SimulatedRig
from devices.simulated.settings import PaintingKind, SimulationSettings
from devices.simulated.truth import SceneTruth, truth_of
from workstation.benchmark_records import Record, Sense

_CAMERA_WIDTH = 1024
_PERIOD_PX = 24.0
_FRAME_S = 1 / 60
_PERIODS = (1, 3, 9, 27, 81)
# Of a saturated sample's noise: a fringe that comes closer to the ceiling may saturate.
_HEADROOM_SIGMAS = 4.0
# A coordinate this far off is none, px: light from elsewhere, or a wrong period.
_WRONG_PX = 2.0


def hdr_records() -> list[Record]:
    """Decoded share of the surface: of the whole bracket, metered, and of its best exposure."""
    rig = SimulationSettings(painting=PaintingKind.TORTURE, camera_width=_CAMERA_WIDTH).build()
    with TemporaryDirectory() as folder:
        full = _record(rig, Path(folder) / "full")
        truth = truth_of(rig.scene)
        surface = _surface(truth)
        decodable = surface & optically_decodable(rig, truth)
        shares = {n: _decoded(full, _only(full.plan, n), truth, decodable) for n in _PERIODS}
        whole = _decoded(full, full.plan, truth, decodable)
        metered = _record_metered(full, Path(folder) / "metered")
        chosen = _decoded(metered, metered.plan_of(Purpose.CODE), truth, decodable)
    best = max(shares, key=lambda periods: shares[periods].share)
    single = ", ".join(f"{n}: {shares[n].share:.1%}" for n in _PERIODS)
    return [
        Record(
            name="hdr.decoded_share",
            value=whole.share,
            unit="",
            bound=0.98,
            sense=Sense.AT_LEAST,
            note=f"of what is optically decodable, {decodable.sum() / surface.sum():.1%} of the "
            f"torture piece; exposures of {_PERIODS} frame periods; of what is decoded "
            f"{whole.wrong:.2%} is off by more than {_WRONG_PX:g} px",
        ),
        Record(
            name="hdr.decoded_share_metered",
            value=chosen.share,
            unit="",
            bound=0.98,
            sense=Sense.AT_LEAST,
            note=f"the same from {len(metered.recorded)} of {len(full.recorded)} frames",
        ),
        Record(
            name="hdr.gain_over_best_exposure",
            value=whole.share / shares[best].share,
            unit="",
            bound=1.0,
            sense=Sense.AT_LEAST,
            note=f"the single best exposure, {best} periods, decodes {shares[best].share:.1%}; "
            f"each alone {single}",
        ),
    ]


def optically_decodable(rig: SimulatedRig, truth: SceneTruth) -> NDArray[np.bool_]:
    """Pixels that some exposure could decode, by the scene's light alone.

    Returns
    -------
    (rows, cols) bool array
    """
    scene, sensor = rig.scene, rig.scene.sensor
    panel = scene.panel
    lit = truth.shading > 0
    for axis, extent in ((0, truth.projector.width), (1, truth.projector.height)):
        with np.errstate(invalid="ignore"):
            lit &= (truth.panel[..., axis] >= 0) & (truth.panel[..., axis] <= extent - 1)
    ambient = scene.view().ambient.reshape(lit.shape)
    dimming = np.exp(-2 * (np.pi * panel.blur_px / _PERIOD_PX) ** 2)
    swing = truth.shading * (1 - panel.black) / 2
    mean = ambient + truth.shading * panel.black + swing
    decodable = np.zeros(lit.shape, np.bool_)
    for periods in range(_PERIODS[0], _PERIODS[-1] + 1):
        scale = sensor.rate_e_per_s * periods * _FRAME_S
        electrons = scale * mean + sensor.dark_e_per_s * periods * _FRAME_S
        noise = np.sqrt(
            sensor.read_noise_e**2 + electrons + 1 / (12 * sensor.numbers_per_electron**2)
        )
        top = electrons + scale * swing * dimming + _HEADROOM_SIGMAS * noise
        full_e = (sensor.saturation_level - sensor.black_level) / sensor.numbers_per_electron
        seen = scale * swing * dimming > DecodingOptions().minimum_contrast * noise
        decodable |= seen & (top < full_e)
    return lit & decodable


def _surface(truth: SceneTruth) -> NDArray[np.bool_]:
    """Pixels that see the canvas, not its frame nor the wall."""
    half = np.array(truth.scene.subject.surface.canvas_mm) / 2
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(truth.points[..., :2]) <= half).all(axis=-1))


def _record(rig: SimulatedRig, out: Path) -> Session:
    devices = rig.open()
    plan = plan_scan(
        devices, exposure_s=tuple(_FRAME_S * n for n in _PERIODS), period_px=_PERIOD_PX
    )
    with SessionWriter.create(out, plan) as writer:
        scan(writer, devices)
    return Session.open(out)


def _record_metered(full: Session, out: Path) -> Session:
    plan = full.plan.model_copy(update={"metering": Metering()})
    with replay_rig(recording_of(full)) as rig, SessionWriter.create(out, plan) as writer:
        record_plan(writer, rig)
    return Session.open(out)


def _only(plan: Plan, periods: int) -> Plan:
    frames = tuple(f for f in plan.frames if f.exposure_s == _FRAME_S * periods)
    return plan.model_copy(update={"frames": frames})


@dataclass(frozen=True)
class _Decoded:
    """Share of the decodable pixels that were decoded rightly, and of the decoded ones wrongly."""

    share: float
    wrong: float


def _decoded(
    session: Session, plan: Plan, truth: SceneTruth, decodable: NDArray[np.bool_]
) -> _Decoded:
    found: CorrespondenceMap = decode(plan, session.read_frame)
    right = found.valid.copy()
    for axis, column in ((Axis.COLUMN, 0), (Axis.ROW, 1)):
        apart = np.abs(found.axes[axis].coordinate - truth.panel[..., column])
        with np.errstate(invalid="ignore"):
            right &= apart < _WRONG_PX
    there = found.valid & decodable
    return _Decoded(
        float((right & decodable).sum() / decodable.sum()),
        float((there & ~right).sum() / max(1, there.sum())),
    )
