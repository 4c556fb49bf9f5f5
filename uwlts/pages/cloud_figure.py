"""Interactive point cloud of a page: the desk's view (`VIEW`), its libraries and points, compressed within the page."""

import base64
import gzip
import json
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

VIEW = Path(__file__).with_name("cloud_view.js")
"""Component of Vue that draws a cloud; the desk uses it, too."""
_SPEC = find_spec("nicegui")
assert _SPEC is not None and _SPEC.origin is not None
# The specification is enough: importing NiceGUI takes a second.
_NICEGUI = Path(_SPEC.origin).parent
THREE = _NICEGUI / "elements" / "scene" / "dist" / "index.js"
"""NiceGUI's copy of three.js."""
_VUE = _NICEGUI / "static" / "vue.esm-browser.prod.js"
_LARGEST = 2**13 - 1
"""Number of steps on either side of the middle: steps of 8 µm for 130 mm, finer than a pixel."""
_UNKNOWN = -(2**15)


@dataclass(frozen=True, eq=False)
class CloudPoints:
    """Points for a view of a page.

    Attributes
    ----------
    points_mm : (N, 3) float64
        Positions, mm.
    values : (N,) float64 or None
        Field that is shown by colour, NaN where unknown; None: Z.
    limit : float
        Value at the end of the colour scale, which is symmetric about zero.
    unit : str
        Unit of the field.
    stops : tuple
        Colours: place from 0 to 1, and red, green, blue from 0 to 255.
    eye : tuple
        Direction from the middle of the points to the viewer.
    """

    points_mm: np.ndarray
    values: np.ndarray | None
    limit: float
    unit: str
    stops: tuple[tuple[float, tuple[int, int, int]], ...]
    eye: tuple[float, float, float]

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
                "limits": None if self.values is None else [-self.limit, self.limit],
                "unit": self.unit,
                "stops": [[place, [each / 255 for each in colour]] for place, colour in self.stops],
                "eye": self.eye,
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
