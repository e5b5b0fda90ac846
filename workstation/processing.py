"""From a session on disk to a digital copy on disk, stage by stage, with the figures of each.

A stage runs only when the recording, the calibration or a parameter that it depends on has changed
since its result was stored (:mod:`workstation.stage_cache`). Reflectance does not depend on the
classification of the relief, nor the other way round.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import DecodingOptions, decode
from acquisition.plan import Purpose
from acquisition.session import JOURNAL_FILE, Session
from acquisition.session_mosaic import mosaic_of, warning_of_colours
from calibration.errors import CalibrationError
from calibration.registration import RegisteredView, register_photographs
from calibration.rig_geometry import RigGeometry
from devices.bayer import BayerPattern
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.held_out import Comparison
from fitting.reflectance.lamp_table import LampTable
from fitting.reflectance.recorded_photographs import PhotographOptions, read_photographs
from fitting.relief import Relief
from fitting.relief_classification import ReliefOptions, classify_relief
from fitting.surface import Surface, SurfaceOptions, reconstruct_surface
from workstation.interruption import interruption_held
from workstation.processing_figures import (
    errors_by_stage,
    reflectance_provenance,
    registration_figures,
    relief_figures,
    scan_figures,
)
from workstation.reflectance_processing import (
    AddedReflectance,
    ReflectanceOptions,
    add_reflectance,
)
from workstation.stage_cache import StageCache, StageResult, digest_of_files

# Names of the stages, as progress, reports and stored results have them.
DECODING = "decoding"
SURFACE = "reconstructing the surface"
RELIEF = "classifying the relief"
FIGURES = "summing up the scan"
REGISTRATION = "registering the photographs"
REFLECTANCE = "fitting the reflectance"
REFLECTANCE_FIGURES = "summing up the reflectance"


@dataclass(frozen=True, kw_only=True)
class ProcessingOptions:
    """Options of every stage of processing."""

    decoding: DecodingOptions = field(default_factory=DecodingOptions)
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)
    photographs: PhotographOptions = field(default_factory=PhotographOptions)
    reflectance: ReflectanceOptions = field(default_factory=ReflectanceOptions)

    def with_maps(self, **choices: Any) -> ProcessingOptions:
        """The same with other choices for the maps of reflectance, by their names."""
        maps = replace(self.reflectance.maps, **choices)
        return replace(self, reflectance=replace(self.reflectance, maps=maps))


@dataclass(frozen=True)
class PhotographStages:
    """Stages of a session of photographs.

    Attributes
    ----------
    digest : str
        Of the session.
    lamps : str
        Digest of the table of lamps.
    views : StageResult
        Registered places of the camera.
    added : StageResult
        The reflectance.
    figures : StageResult
        What came of both, as plain JSON values.
    warnings : tuple of str
        What is doubtful about the photographs.
    """

    digest: str
    lamps: str
    views: StageResult[dict[str | None, RegisteredView]]
    added: StageResult[AddedReflectance]
    figures: StageResult[dict[str, Any]]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Processed:
    """A processed session, whose results are read from the disk where they are asked for.

    Attributes
    ----------
    session : Session
    rig : RigGeometry
        The calibration in force.
    rig_digest : str
    options : ProcessingOptions
    stages : StageCache
        What became of each stage, and where results are kept.
    """

    session: Session
    rig: RigGeometry
    rig_digest: str
    options: ProcessingOptions
    stages: StageCache
    _correspondence: StageResult[CorrespondenceMap]
    _surface: StageResult[Surface]
    _relief: StageResult[tuple[Relief, dict[str, Any]]]
    _scan_figures: StageResult[dict[str, Any]]
    photographs: PhotographStages | None = None

    @property
    def correspondence(self) -> CorrespondenceMap:
        """The decoded scan."""
        return self._correspondence.get()

    @property
    def surface(self) -> Surface:
        """What led to the heights; its relief is not what was asked for, which the copy has."""
        return self._surface.get()

    @property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Photographs that were kept out of the fit of the reflectance, beside renderings."""
        return () if self.photographs is None else tuple(self.photographs.added.get().comparisons)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was ambiguous or doubtful on the way."""
        doubts = () if self.photographs is None else self.photographs.warnings
        return (*self._scan_figures.get()["warnings"], *doubts)

    @cached_property
    def copy(self) -> DigitalCopy:
        """The digital copy, with its provenance."""
        found = self.surface.copy
        if self.photographs is not None:
            found = self.photographs.added.get().copy
        return replace(found, relief=self._relief.get()[0], provenance=self._provenance())

    @property
    def figures(self) -> dict[str, Any]:
        """Plain JSON values for ``--json`` and reports."""
        seconds = {run.name: round(run.seconds, 3) for run in self.stages.runs}
        return self._lasting_figures | {
            "seconds": seconds,
            "stages": [asdict(run) for run in self.stages.runs],
        }

    @cached_property
    def _lasting_figures(self) -> dict[str, Any]:
        figures = self._scan_figures.get() | self._relief.get()[1]
        if self.photographs is not None:
            figures["reflectance"] = self.photographs.figures.get()
            figures["warnings"] = list(self.warnings)
        return figures

    def _provenance(self) -> dict[str, Any]:
        figures, options = self._lasting_figures, self.options
        parameters = {"decoding": asdict(options.decoding), "surface": asdict(options.surface)}
        found: dict[str, Any] = {
            "software": f"impasto {version('impasto')}",
            "session": self.session.digest,
            "calibration": self.rig_digest,
            "source": self.session.plan.source,
        }
        if self.photographs is not None:
            parameters |= {
                "photographs": asdict(options.photographs),
                "reflectance": asdict(options.reflectance),
            }
            found |= {
                "photographs": self.photographs.digest,
                "lamps": self.photographs.lamps,
                "reflectance": reflectance_provenance(figures["reflectance"]),
            }
        return found | {
            "parameters": plain_options(parameters),
            "errors": errors_by_stage(figures),
            "warnings": figures["warnings"],
        }


def process_session(
    path: Path,
    *,
    calibration: Path | None = None,
    options: ProcessingOptions | None = None,
    stages: StageCache | None = None,
) -> Processed:
    """Process a session into a digital copy in memory.

    Parameters
    ----------
    path : Path
        Session folder.
    calibration : Path, optional
        Folder of a rig calibration to use instead of the session's own.
    options : ProcessingOptions, optional
    stages : StageCache, optional
        Results of earlier runs; by default none, and every stage runs.

    Raises
    ------
    ImpastoError
        From any stage.
    """
    options = options or ProcessingOptions()
    stages = stages or StageCache(None)
    session = Session.open(path)
    folder = calibration or session.calibration_folder
    if folder is None:
        raise CalibrationError(
            f"{path}: the session has no rig calibration, so it can be decoded but not "
            "triangulated; name one with --calibration DIR"
        )
    rig = RigGeometry.load(folder)
    _check_sizes(session, rig, folder)
    rig_digest = digest_of_files(folder)

    def decoded() -> CorrespondenceMap:
        with interruption_held():
            return decode(session.plan_of(Purpose.CODE), session.read_frame, options.decoding)

    correspondence = stages.run(
        DECODING, decoded, depends_on=_recorded(session), parameters=options.decoding
    )

    def reconstructed() -> Surface:
        with interruption_held():
            return reconstruct_surface(correspondence.get(), rig, all_but_relief)

    # The relief is classified by a stage of its own, whose options change nothing here.
    all_but_relief = replace(options.surface, relief=ReliefOptions())
    surface = stages.run(
        SURFACE,
        reconstructed,
        depends_on=(correspondence.key, rig_digest),
        parameters=all_but_relief,
    )

    def classified() -> tuple[Relief, dict[str, Any]]:
        heights = surface.get().copy.height_field
        found = classify_relief(heights, options.surface.relief)
        return found, relief_figures(heights, found)

    relief = stages.run(
        RELIEF, classified, depends_on=(surface.key,), parameters=options.surface.relief
    )

    figures = stages.run(
        FIGURES,
        lambda: scan_figures(correspondence.get(), surface.get()),
        depends_on=(surface.key,),
        parameters=None,
    )
    return Processed(
        session, rig, rig_digest, options, stages, correspondence, surface, relief, figures
    )


def add_photographs(processed: Processed, path: Path, lamps: Path) -> Processed:
    """Give a processed scan the reflectance that a session of photographs shows.

    Parameters
    ----------
    processed : Processed
        Its options and stored results are used.
    path : Path
        Session of photographs: the projected code and the lamp's poses from each place.
    lamps : Path
        Table of lamps (:class:`~fitting.reflectance.lamp_table.LampTable`).

    Raises
    ------
    ImpastoError
        From any stage.
    """
    session, stages = Session.open(path), processed.stages
    mosaic = mosaic_of(session, processed.options.photographs.mosaic)
    read = replace(processed.options.photographs, mosaic=mosaic)
    options = replace(processed.options, photographs=read)
    doubt = warning_of_colours(session, mosaic)
    table = LampTable.load(lamps)
    lamps_digest = hashlib.sha256(Path(lamps).read_bytes()).hexdigest()

    def registered() -> dict[str | None, RegisteredView]:
        with interruption_held():
            return register_photographs(
                session, processed.correspondence, processed.rig, decoding=options.decoding
            )

    views = stages.run(
        REGISTRATION,
        registered,
        depends_on=(*_recorded(session), processed._correspondence.key, processed.rig_digest),
        parameters=options.decoding,
    )

    def fitted() -> AddedReflectance:
        copy = processed.surface.copy
        with TemporaryDirectory(prefix="impasto-photographs-") as scratch:
            with interruption_held():
                photographs = read_photographs(
                    session,
                    views.get(),
                    table,
                    copy.height_field.rt_cam_canvas,
                    scratch=Path(scratch),
                    options=options.photographs,
                )
            return add_reflectance(
                copy,
                photographs,
                surface=processed.surface,
                options=options.reflectance,
                begin=stages.begin,
            )

    added = stages.run(
        REFLECTANCE,
        fitted,
        depends_on=(views.key, processed._surface.key, lamps_digest),
        parameters={
            "photographs": asdict(options.photographs),
            "reflectance": asdict(options.reflectance),
        },
    )
    figures = stages.run(
        REFLECTANCE_FIGURES,
        lambda: added.get().figures | {"registration": registration_figures(views.get())},
        depends_on=(added.key,),
        parameters=None,
    )
    return replace(
        processed,
        options=options,
        photographs=PhotographStages(
            *(session.digest, lamps_digest, views, added, figures),
            warnings=() if doubt is None else (doubt,),
        ),
    )


def _recorded(session: Session) -> tuple[str, ...]:
    """Digests of all that was recorded: of the frames, and of when and how long they took."""
    journal = (session.path / JOURNAL_FILE).read_bytes()
    return session.digest, hashlib.sha256(journal).hexdigest()


def plain_options(value: Any) -> Any:
    """Options as JSON has them."""
    match value:
        case dict():
            return {key: plain_options(inner) for key, inner in value.items()}
        case tuple() | list():
            return [plain_options(inner) for inner in value]
        case BayerPattern():
            return value.value
        case np.ndarray():
            return f"{value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        case float() if not np.isfinite(value):
            return str(value)
    return value


def _check_sizes(session: Session, rig: RigGeometry, folder: Path) -> None:
    for name, lens, imager in (
        ("camera", rig.camera, session.plan.camera),
        ("projector", rig.projector, session.plan.projector),
    ):
        if (lens.width, lens.height) != (imager.width, imager.height):
            raise CalibrationError(
                f"{folder}: the {name} was calibrated at {lens.width}×{lens.height}, the session "
                f"was recorded at {imager.width}×{imager.height}"
            )
