"""Interactive point cloud of a page: the desk's view (`VIEW`), its libraries and points, compressed within the page.

The colour scale of deviations and the viewing direction are those of static plots, too.
"""

import base64
import gzip
import json
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np

CloudField = Literal["deviation", "depth", "intensity", "random", "common"]
"""Quantities of points that colours show: Z for "depth"; the last two are parts of the standard uncertainty."""
PARTS: dict[CloudField, str] = {
    "random": "Random standard uncertainty along the surface normal, by noise and by errors of single images: a length "
    "contains that of its ends.",
    "common": "Standard uncertainty along the surface normal by errors that all points share: a length contains only "
    "their difference between its ends.",
}
"""Captions of the parts of the uncertainty."""

VIEW = Path(__file__).with_name("cloud_view.js")  # component of Vue that draws a cloud; the desk uses it, too
_SPEC = find_spec("nicegui")
assert _SPEC is not None and _SPEC.origin is not None
# The specification is enough: importing NiceGUI takes a second.
_NICEGUI = Path(_SPEC.origin).parent
THREE = _NICEGUI / "elements" / "scene" / "dist" / "index.js"
"""NiceGUI's copy of three.js."""
_VUE = _NICEGUI / "static" / "vue.esm-browser.prod.js"
_LARGEST = 2**13 - 1
"""Number of steps on either side of the middle: steps of 8 µm for 130 mm, finer than a pixel."""
_UNKNOWN = -(2**15)  # the one 16-bit number that stands for no value


STOPS = (
    (0.0, (33, 82, 172)),
    (0.25, (99, 161, 214)),
    (0.5, (205, 205, 200)),
    (0.75, (236, 139, 96)),
    (1.0, (170, 21, 40)),
)
"""Colour scale of deviations: position between -1 and +1 limit (0 to 1), and red, green, blue."""
COLOURS = [[place, [each / 255 for each in colour]] for place, colour in STOPS]  # as the script reads it

LIMIT_STD = 2.0  # range of the deviation colours in standard deviations, as in the thesis

AZIMUTH_DEG = 28.0  # viewing direction of clouds: angle from +X towards +Y, deg
ELEVATION_DEG = 38.0  # viewing direction of clouds: angle downwards (towards +Z), deg


def view_direction() -> np.ndarray:
    """Return the viewing direction of clouds, a unit vector (3,) in the OCS."""
    azimuth, elevation = np.radians((AZIMUTH_DEG, ELEVATION_DEG))
    across = np.cos(elevation)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])


def colour_limit_mm(deviation_mm: np.ndarray) -> float:
    """Return the limit of the deviation colours: `LIMIT_STD` standard deviations, above zero."""
    finite = deviation_mm[np.isfinite(deviation_mm)].astype(np.float64)
    return max(LIMIT_STD * float(finite.std()), 1e-9) if len(finite) else 1e-9


def scale_values(values: np.ndarray, field: CloudField) -> tuple[np.ndarray, str, float | None]:
    """Return values (N,) of a quantity, in mm or grey values, in the unit in which they are drawn, and this unit.

    Lengths of a fraction of a millimetre are in µm. The last number is the end of the colours for a deviation.
    """
    if field in ("depth", "intensity"):
        return values, "mm" if field == "depth" else "grey values", None
    known = np.abs(values[np.isfinite(values)])
    limit = colour_limit_mm(values) if field == "deviation" else None
    spread = limit or (float(np.median(known)) if len(known) else 1.0)
    unit, factor = ("µm", 1e3) if spread < 0.5 else ("mm", 1.0)
    return factor * values, unit, None if limit is None else factor * limit


@dataclass(frozen=True, eq=False)
class CloudPoints:
    """Points for a view of a page, seen along `view_direction`."""

    points_mm: np.ndarray  # (N, 3); positions, mm
    field: CloudField  # quantity that is shown by colour
    values: np.ndarray | None  # (N,) or None; the quantity, NaN where unknown; None for "depth", which is Z
    unit: str  # unit of the quantity
    limit: float | None
    """Value at the end of the scale `STOPS`, which is symmetric about zero; None for the range of the values."""

    def to_json(self) -> str:
        """Return the text that the page's script reads; steps are 1/16382 of the range of each column."""
        columns = [*self.points_mm.T, *(() if self.values is None else (self.values,))]
        packed = [_pack_column(column) for column in columns]
        return json.dumps(
            {
                "count": len(self.points_mm),
                "offset": [offset for offset, _, _ in packed],
                "step": [step for _, step, _ in packed],
                "data": encode_script(b"".join(data for _, _, data in packed)),
                "field": self.field,
                "unit": self.unit,
                "limits": None if self.limit is None else [-self.limit, self.limit],
                "stops": None if self.limit is None else COLOURS,
                "eye": (-view_direction()).tolist(),
            }
        )


def _pack_column(values: np.ndarray) -> tuple[float, float, bytes]:
    """Return offset and step of a column (N,), and differences between neighbours, 16 bit: low bytes, then high bytes.

    Differences of scans are small, and gzip finds more repetition in separate bytes.
    """
    known = values[np.isfinite(values)].astype(np.float64)
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    offset, step = (low + high) / 2, (high - low) / (2 * _LARGEST) or 1.0
    numbers = np.full(len(values), _UNKNOWN, np.int16)
    numbers[np.isfinite(values)] = np.round((known - offset) / step).astype(np.int16)
    # Differences wrap around, and so do their sums.
    differences = np.diff(numbers, prepend=np.int16(0)).astype("<i2")
    return offset, step, differences.view(np.uint8).reshape(-1, 2).T.tobytes()


def encode_script(content: bytes) -> str:
    """Return content compressed by gzip, as text for a script element; the same content gives the same text."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def view_scripts() -> dict[str, str]:
    """Return the compressed scripts of the view by name, in the order in which they need each other."""
    return {name: encode_script(path.read_bytes()) for name, path in (("three", THREE), ("vue", _VUE), ("view", VIEW))}
