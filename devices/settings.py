"""What the tables of a ``rig.toml`` have in common."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

# Where a device is: a port, a path, a URL; the system's own errors do not name an empty one.
Address = Annotated[str, Field(pattern=r"^[^\x00]+$")]


class DriverSettings(BaseModel):
    """Settings of one driver, as they stand in a table of ``rig.toml``.

    A driver's settings name it in ``driver`` (a ``Literal``), hold what it needs in the units of
    ``rig.toml`` (degrees, mm, seconds), and ``open`` its device.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
