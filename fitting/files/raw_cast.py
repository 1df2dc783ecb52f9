"""One cast as a file holds it, before anything is checked."""

import dataclasses
from collections.abc import Mapping

import numpy as np


@dataclasses.dataclass(frozen=True)
class RawCast:
    """Columns by name with the units that the file states, quality flags by column.

    `comment`: free text of the header; `latitude`: degrees north; `counts`: what was left out;
    `time`: (row,) of each row in any unit, None where the file does not say: then rows stand in
    the order in which they were measured; `longitude`: degrees east; `began`: date and time, UTC,
    ISO 8601; `platform` and `cycle`: of a float.
    """

    name: str
    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    flags: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    comment: str = ""
    latitude: float | None = None
    solar_zenith: float | None = None
    counts: Mapping[str, int] = dataclasses.field(default_factory=dict)
    time: np.ndarray | None = None
    longitude: float | None = None
    began: str | None = None
    platform: str | None = None
    cycle: int | None = None

    @property
    def station(self) -> dict[str, float | str | int]:
        """What the file says of where, when and by what the cast was measured."""
        known = {
            "latitude": self.latitude,
            "longitude": self.longitude,
            "time": self.began,
            "platform": self.platform,
            "cycle": self.cycle,
        }
        return {name: value for name, value in known.items() if value is not None}
