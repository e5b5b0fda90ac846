"""A camera that is moved by hand: the person at the desk is asked to, and confirms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from devices.errors import DeviceError
from devices.interfaces import CameraMount
from devices.settings import DriverSettings


def nobody_confirms(question: str) -> bool:
    """Answer for where nobody is at the desk: no."""
    return False


class ManualMountSettings(DriverSettings):
    """The ``[mount]`` table of a ``rig.toml`` for a camera moved by hand.

    Attributes
    ----------
    positions : tuple of str
        Names of the places where the camera can stand.
    start : str, optional
        Where it stands at first; by default, the first of ``positions``.
    """

    driver: Literal["manual"] = "manual"
    positions: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1)]
    start: str | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(set(self.positions)) < len(self.positions):
            raise ValueError("positions: a name occurs twice")
        if self.start is not None and self.start not in self.positions:
            raise ValueError(f"start: {self.start!r} is none of the positions")
        return self

    def open(self, *, confirm: Callable[[str], bool] = nobody_confirms) -> CameraMount:
        """The mount.

        Parameters
        ----------
        confirm : callable
            Asks the person at the desk to do something; true once it is done.
        """
        return ManualMount(self.positions, start=self.start, confirm=confirm)


class ManualMount:
    """A camera on a tripod or a rail, and a person who moves it.

    Parameters
    ----------
    positions : tuple of str
    start : str, optional
        Where it stands at first; by default, the first of ``positions``.
    confirm : callable
        Asks the person at the desk to do something; true once it is done.
    """

    def __init__(
        self,
        positions: tuple[str, ...],
        *,
        start: str | None = None,
        confirm: Callable[[str], bool] = nobody_confirms,
    ) -> None:
        self._positions = positions
        self._position = positions[0] if start is None else start
        self._confirm = confirm

    @property
    def positions(self) -> tuple[str, ...]:
        """Names of the places."""
        return self._positions

    @property
    def position(self) -> str:
        """Where the camera stands, as was last confirmed."""
        return self._position

    def place(self, position: str) -> None:
        """Ask for the camera to be moved, unless it stands there.

        Raises
        ------
        DeviceError
            There is no such place, or nobody confirmed the move.
        """
        if position not in self._positions:
            raise DeviceError(
                f"there is no camera position {position!r}; rig.toml names "
                f"{', '.join(self._positions)}"
            )
        if position == self._position:
            return
        if not self._confirm(f"Move the camera from {self._position} to {position}."):
            raise DeviceError(
                f"nobody confirmed that the camera stands at {position}; it is taken to be at "
                f"{self._position} still"
            )
        self._position = position
