"""What the tables of a ``rig.toml`` have in common."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class DriverSettings(BaseModel):
    """Settings of one driver, as they stand in a table of ``rig.toml``.

    A driver's settings name it in ``driver`` (a ``Literal``), hold what it needs in the units of
    ``rig.toml`` (degrees, mm, seconds), and ``open`` its device.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
