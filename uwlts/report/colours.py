"""The colours of deviations: blue below, grey at zero, red above."""

import numpy as np

STOPS = (
    (0.0, (33, 82, 172)), (0.25, (99, 161, 214)), (0.5, (205, 205, 200)), (0.75, (236, 139, 96)), (1.0, (170, 21, 40)),
)  # fmt: skip
"""Place between -1 and +1 limit (0 to 1), and its colour red-green-blue."""

UNKNOWN = (85, 85, 80)
"""Red-green-blue of points without a deviation, among others that have one."""

PLAIN = (93, 130, 168)
"""Red-green-blue of the points of a cloud without deviations."""

LIMIT_STD = 2.0
"""The colours end at this many standard deviations, as in the thesis."""


def plotly_scale() -> list[list[float | str]]:
    """The same colours for plotly."""
    return [[place, "rgb({}, {}, {})".format(*colour)] for place, colour in STOPS]


def coloured(share: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8, red-green-blue, of shares (N,) of the limit from -1 to 1; beyond it the last colour."""
    places, colours = zip(*STOPS, strict=True)
    position = (np.clip(share, -1, 1) + 1) / 2
    channels = [np.interp(position, places, channel) for channel in zip(*colours, strict=True)]
    rgb = np.round(np.nan_to_num(np.column_stack(channels))).astype(np.uint8)
    rgb[np.isnan(share)] = PLAIN if np.isnan(share).all() else UNKNOWN
    return rgb


def colour_limit_mm(deviation_mm: np.ndarray) -> float:
    """Deviation at which the colours end: twice the standard deviation, or the next thing to nothing."""
    finite = deviation_mm[np.isfinite(deviation_mm)].astype(np.float64)
    return max(LIMIT_STD * float(finite.std()), 1e-9) if len(finite) else 1e-9
