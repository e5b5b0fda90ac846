"""Holding every frame against those before it: stale, repeated, lost and swapped frames.

A count alone does not catch a driver that hands out what it has buffered: its frames follow one
another properly, each one too late. Their times give them away. A projector that still shows the
previous picture delivers a fresh frame of the wrong subject; that one differs from the frame before
it by nothing but noise and a flicker of the light. Two lights can look alike where the camera sees
only a part of the panel, though, so such a frame is not refused: it needs a proof, which
:class:`~devices.rig.Rig` takes by changing the light and back. The first light of a recording needs
one always, or a projector that is late from the beginning would shift every frame unnoticed.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.errors import FrameOrderError
from devices.interfaces import ArmPose, CameraCapabilities, Frame, Subject

# Rounding of times on the monotonic clock.
_CLOCK_S = 1e-6
# How long after its delivery a frame's exposure may seem to begin: cameras' clocks drift.
_AHEAD_S = 0.05
# Rows that the comparison of two frames looks at, about.
_ROWS = 200
# A lamp's flicker from one frame to the next stays below this share.
_FLICKER = 0.05
# Two exposures are in the ratio that the camera reports, but for this share.
_EXPOSURE_ERROR = 0.2
# Exposures that differ by less are the same, by a camera that measures each.
_SAME_EXPOSURE = 0.01
# Standard deviations beyond which a sum of products is no chance.
_UNLIKELY = 5.0
# Neighbours in a difference of two frames correlate by less if it is noise.
_LEAST_CORRELATION = 0.05
# Samples on either side of every edge that a comparison needs to say anything.
_LEAST_SIZE = 16
# A frame of which fewer samples lie between its extremes can be like another by chance.
_LEAST_NOISE = 0.01


@dataclass(frozen=True)
class Light:
    """What lights a scene, and where from it is seen: frames of the same light look alike.

    Attributes
    ----------
    projection : str or None
        Digest of what is projected; None when the projector is dark, or shows black.
    lamp_on : bool
        Whether the arm's lamp is lit.
    lamp_pose : ArmPose or None
        Where the lamp is lit; None when it is not, because a dark lamp may stand anywhere.
    camera_position : str or None
    """

    projection: str | None = None
    lamp_on: bool = False
    lamp_pose: ArmPose | None = None
    camera_position: str | None = None

    @property
    def dark(self) -> bool:
        """Whether the rig lights nothing."""
        return self.projection is None and not self.lamp_on


class FrameOrder:
    """Refuses frames that cannot be the picture of their subject; one per recording.

    Parameters
    ----------
    saturation_level : int, optional
        Of the camera; saturated samples say nothing about the light.
    """

    def __init__(self, *, saturation_level: int | None = None) -> None:
        self._saturation_level = saturation_level
        self._last: Frame | None = None
        self._delivered: dict[bytes, Subject] = {}
        self._light: Light | None = None
        self._light_before: Light | None = None
        # A picture of each exposure, under this light and under the one before.
        self._pictures: dict[float, NDArray[Any]] = {}
        self._pictures_before: dict[float, NDArray[Any]] = {}
        # Pictures without light, by place of the camera and exposure.
        self._darkness: dict[str | None, dict[float, NDArray[Any]]] = {}
        self._proven = False

    @property
    def light_before(self) -> Light | None:
        """The light before that of the last frame."""
        return self._light_before

    def check(
        self,
        frame: Frame,
        *,
        light: Light,
        subject_since_s: float,
        delivered_s: float = math.inf,
    ) -> bool:
        """Hold a frame against its subject and against the frames before it.

        Parameters
        ----------
        frame : Frame
            With its subject.
        light : Light
            That the scene is under.
        subject_since_s : float
            Monotonic time since when the subject has been there and the frame was asked for.
        delivered_s : float
            Monotonic time at which the camera handed it out.

        Returns
        -------
        bool
            False if the light may not have changed as it was told to: the picture differs from one
            under the light before, or from darkness, by noise only, or there is none to compare it
            with. Then
            :meth:`accept_light` is to be called once the light was seen to follow.

        Raises
        ------
        FrameOrderError
            The camera's count jumped or stood still, the exposure began before the subject was
            there or after the frame was delivered, or the picture is that of an earlier frame
            to the last sample.
        """
        self._check_count(frame)
        self._check_times(frame, subject_since_s, delivered_s)
        self._check_novelty(frame)
        if light != self._light:
            self._light_before, self._light = self._light, light
            self._pictures_before, self._pictures = self._pictures, {}
            self._proven = False
        last, self._last = self._last, frame
        rows = _rows(frame.image)
        _keep(self._pictures, frame.exposure_applied_s, rows.copy())
        if not self._proven:
            self._proven = self._is_dark_still(light) or (
                self._follows_the_light(frame, rows, last) and not self._looks_dark(frame, light)
            )
        if light.dark:
            darkness = self._darkness.setdefault(light.camera_position, {})
            _keep(darkness, frame.exposure_applied_s, rows.copy())
        return self._proven

    def knows_darkness(self, camera_position: str | None) -> bool:
        """Whether there was a frame without light from a place."""
        return camera_position in self._darkness

    def accept_light(self) -> None:
        """The light of the last frame was seen to be there; more frames of it need no proof."""
        self._proven = True

    def _check_count(self, frame: Frame) -> None:
        last = self._last
        if last is not None and frame.sequence != last.sequence + 1:
            raise FrameOrderError(
                f"frame of {frame.subject}: the camera delivered its number {frame.sequence} after "
                f"{last.sequence}; a frame was lost, repeated or swapped, so resume to take it "
                "again"
            )

    def _check_times(self, frame: Frame, since_s: float, delivered_s: float) -> None:
        ended, exposure = frame.monotonic_s, frame.exposure_applied_s
        if not (math.isfinite(ended) and math.isfinite(exposure) and exposure > 0):
            raise FrameOrderError(
                f"frame of {frame.subject}: the camera says that an exposure of {exposure} s ended "
                f"at {ended} s; restart it and resume"
            )
        # A simulated exposure is not waited for, and begins when the one before it would end.
        last_ended_s = -math.inf if self._last is None else self._last.monotonic_s
        early = max(since_s, last_ended_s) - (ended - exposure)
        if early > _CLOCK_S:
            raise FrameOrderError(
                f"frame of {frame.subject} is stale: its exposure began {early * 1000:.0f} ms "
                "before that was there; empty the camera's buffer and resume"
            )
        ahead = ended - exposure - max(delivered_s, last_ended_s)
        if self._last is not None and ahead > _AHEAD_S:
            raise FrameOrderError(
                f"frame of {frame.subject} was delivered {ahead * 1000:.0f} ms before its exposure "
                "began, by the camera's clock: that jumped, and stale frames could no longer be "
                "told; restart the camera and resume"
            )

    def _check_novelty(self, frame: Frame) -> None:
        """Refuse a picture equal to an earlier one, unless it is too flat to carry noise."""
        digest = hashlib.blake2b(frame.image.tobytes(), digest_size=16).digest()
        earlier = self._delivered.get(digest)
        if earlier is not None and _is_noisy(frame.image):
            raise FrameOrderError(
                f"frame of {frame.subject} is that of {earlier} over again, to the last sample; "
                "the camera repeats itself under a new number, so restart it and resume"
            )
        self._delivered[digest] = frame.subject

    def _is_dark_still(self, light: Light) -> bool:
        """Whether nothing was lit before, and nothing is now."""
        return light.dark and (self._light_before is None or self._light_before.dark)

    def _follows_the_light(self, frame: Frame, rows: NDArray[Any], last: Frame | None) -> bool:
        """Whether a picture differs from those under the light before."""
        if last is None or not self._pictures_before:
            return False
        exposure = frame.exposure_applied_s
        if last.exposure_applied_s != exposure and not differ_beyond_noise(
            rows, _rows(last.image), saturation_level=self._saturation_level
        ):
            # The frame before, exposure and all.
            return False
        return self._differs_from(self._pictures_before, rows, exposure)

    def _looks_dark(self, frame: Frame, light: Light) -> bool:
        """Whether a picture under light is like one without, or darker still.

        A lamp that fails changes the picture as its next light would; a recording must not end with
        such a frame, nor be resumed after it.
        """
        darkness = self._darkness.get(light.camera_position)
        if light.dark or not darkness:
            return False
        exposure, rows = frame.exposure_applied_s, _rows(frame.image)
        same = _same_exposure(darkness, exposure)
        if same is not None and rows.mean() <= darkness[same].mean():
            return True
        return not self._differs_from(darkness, rows, exposure)

    def _differs_from(
        self, pictures: dict[float, NDArray[Any]], rows: NDArray[Any], exposure: float
    ) -> bool:
        """Whether a picture differs from that of the nearest exposure among others."""
        nearest = _nearest_exposure(pictures, exposure)
        return differ_beyond_noise(
            rows,
            pictures[nearest],
            exposure_ratio=exposure / nearest,
            saturation_level=self._saturation_level,
        )


def _nearest_exposure(pictures: dict[float, NDArray[Any]], exposure: float) -> float:
    return min(pictures, key=lambda other: abs(math.log(exposure / other)))


def _same_exposure(pictures: dict[float, NDArray[Any]], exposure: float) -> float | None:
    """The exposure among pictures' that is the same, by a camera that measures each; or None."""
    if not pictures:
        return None
    nearest = _nearest_exposure(pictures, exposure)
    return nearest if abs(math.log(exposure / nearest)) < _SAME_EXPOSURE else None


def _keep(pictures: dict[float, NDArray[Any]], exposure: float, rows: NDArray[Any]) -> None:
    """Keep a picture in place of the one of the same exposure: measured ones would pile up."""
    same = _same_exposure(pictures, exposure)
    if same is not None:
        del pictures[same]
    pictures[exposure] = rows


def check_request(frame: Frame, exposure_s: float, camera: CameraCapabilities) -> None:
    """Refuse a frame of another exposure than was asked for, or of another size or type.

    Raises
    ------
    FrameOrderError
        It is another frame, or a part of one.
    """
    if not math.isclose(frame.exposure_asked_s, exposure_s):
        raise FrameOrderError(
            f"frame of {frame.subject} was asked for with {exposure_s:g} s and is one that was "
            f"asked for with {frame.exposure_asked_s:g} s; empty the camera's buffer and resume"
        )
    image = frame.image
    if image.shape != (camera.height, camera.width) or image.dtype not in (np.uint8, np.uint16):
        size = "×".join(map(str, reversed(image.shape)))
        raise FrameOrderError(
            f"frame of {frame.subject} is {image.dtype} of {size}, and {camera.model} takes "
            f"{camera.width}×{camera.height}: it was cut off on its way, so look at the camera's "
            "cable and resume"
        )


def differ_beyond_noise(
    image: NDArray[Any],
    other: NDArray[Any],
    *,
    exposure_ratio: float = 1.0,
    saturation_level: int | None = None,
) -> bool:
    """Whether two pictures show different light.

    What a lamp or a projector changes is alike in neighbouring pixels; noise is not, so the
    products of near pixels in their difference vanish on average. A flicker of the light and an
    offset, which change nothing but the scale, are taken out first. Pixels two and four columns
    apart are compared, which have the same colour in a mosaic. Large pictures are compared in some
    of their rows.

    Parameters
    ----------
    image, other : (rows, cols) array
        Sensor numbers. Pictures too small to tell count as different.
    exposure_ratio : float
        Exposure of ``image`` over that of ``other``.
    saturation_level : int, optional
        Where both are saturated they are not compared; pictures that are all saturated show no
        difference.
    """
    if image.shape != other.shape or min(image.shape) < _LEAST_SIZE:
        return True
    if exposure_ratio > 1:
        # The longer exposure, with less noise, is what the other is held against.
        image, other, exposure_ratio = other, image, 1 / exposure_ratio
    image, other = _rows(image), _rows(other)
    same_exposure = exposure_ratio > 1 - _SAME_EXPOSURE
    valid = _comparable(image, other, same_exposure, saturation_level)
    if np.count_nonzero(valid) < _LEAST_SIZE**2:
        return False
    level, other_level = (float(picture.mean(where=valid)) for picture in (image, other))
    a = np.where(valid, image - level, 0.0)
    b = np.where(valid, (other - other_level) * exposure_ratio, 0.0)
    power = float((b * b).sum())
    gain = float((a * b).sum()) / power if power > 0 else 0.0
    slack = _FLICKER if same_exposure else _EXPOSURE_ERROR
    # Noise in the other picture pulls the gain below one, so this side is left to the residual.
    if gain > 1 + slack:
        return True
    if same_exposure and abs(level - other_level) > slack * max(1.0, level, other_level):
        return True
    return _is_structured(a - np.clip(gain, 1 - slack, 1 + slack) * b, valid)


def _is_structured(difference: NDArray[np.float64], valid: NDArray[np.bool_]) -> bool:
    """Whether near pixels of a difference of two pictures are alike.

    Products of unrelated noise sum up to nothing but √Σ(product²), whatever its strength in
    different parts of the picture.
    """
    energy = float((difference**2).sum()) / np.count_nonzero(valid)
    if energy == 0:
        return False
    # A fringe of 8 pixels is uncorrelated with itself 2 pixels on, but not 4 pixels on.
    for lag in (2, 4):
        products = difference[:, lag:] * difference[:, :-lag]
        pairs = np.count_nonzero(valid[:, lag:] & valid[:, :-lag])
        chance = _UNLIKELY * float(np.sqrt((products**2).sum()))
        if abs(products.sum()) > max(chance, _LEAST_CORRELATION * energy * pairs):
            return True
    return False


def _comparable(
    image: NDArray[Any], other: NDArray[Any], same_exposure: bool, saturation_level: int | None
) -> NDArray[np.bool_]:
    """Samples whose light is known well enough to compare, ``other`` having the longer exposure."""
    if saturation_level is None:
        return np.ones(image.shape, bool)
    saturated = other >= saturation_level
    return ~(saturated & (image >= saturation_level)) if same_exposure else ~saturated


def _rows(image: NDArray[Any]) -> NDArray[Any]:
    """Every so manieth row of a picture."""
    return image[:: max(1, len(image) // _ROWS)]


def _is_noisy(image: NDArray[Any]) -> bool:
    """Whether a picture carries noise: not dark or saturated nearly everywhere."""
    rows = _rows(image)
    return bool(((rows > rows.min()) & (rows < rows.max())).mean() > _LEAST_NOISE)
