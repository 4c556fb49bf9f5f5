"""Base class of calibration targets, and parsing of their descriptions."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from uwlts.errors import DescriptionError
from uwlts.model.sensor import Description, NotNegative

_FEWEST_POINTS = 12
"""Fewest points of a target seen in part: fewer points often do not include the marks or markers for their numbers."""
_SMALLEST_SHARE = 0.15  # least fraction of a large target's points, for the same reason


@dataclass(frozen=True)
class TargetView:
    """Points of a target found in one image.

    Attributes
    ----------
    pixels : (N, 2) float64, px, (u, v), pixel (0, 0) is the centre of the first pixel
        Corner, or centre of a circle's image (not the image of its centre: see `circle_centre_bias`).
    points_mm : (N, 3) float64, mm, target frame, z = 0
    indices : (N, 2) int64, place (column, row) of the circle or inner corner, counted from the top left one
    quality : name to (N,) float64
        ``contrast``: difference of bright and dark grey levels at the point. ``sharpness``: steepest slope divided by
        the contrast, 1/px. For circles also ``residual_px``: rms distance of the edge from its ellipse, and
        ``radius_px``: geometric mean of the ellipse's semi-axes.
    """

    pixels: np.ndarray
    points_mm: np.ndarray
    indices: np.ndarray
    quality: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Patch:
    """Part of a target's print: a rectangle with sides along x and y of the target frame, or its inscribed ellipse.

    ``round`` patches are ellipses. Patches that are not ``ink`` have the brightness of the ground around the pattern.
    """

    x_min_mm: float
    y_min_mm: float
    x_max_mm: float
    y_max_mm: float
    round: bool = False
    ink: bool = True


class Target(Description, ABC):
    """Base of calibration targets: a flat pattern of points that are found and numbered in an image.

    For a viewer of the target, X points right, Y down and Z away from the viewer into the target. All points have z =
    0.

    A target type is a subclass with a field ``kind``, whose default is its name in files. All modules of
    `uwlts.targets` are imported with the package, so that classes in them are known. A class elsewhere is known after
    the import of its module.

    Attributes
    ----------
    margin_mm : width of the flat plate beyond the pattern, where a stripe is used as well: one number, or
        [left, top, right, bottom]; by default half the spacing
    """

    margin_mm: NotNegative | tuple[NotNegative, NotNegative, NotNegative, NotNegative] | None = None

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        if "kind" in cls.model_fields:
            _KINDS[cls.model_fields["kind"].default] = cls

    @property
    @abstractmethod
    def indices(self) -> np.ndarray:
        """Indices (N, 2) int64 (column, row) of all points."""

    @abstractmethod
    def points_at(self, indices: np.ndarray) -> np.ndarray:
        """Return points (M, 3) in mm, target frame, with these indices (M, 2)."""

    @property
    @abstractmethod
    def spacing_mm(self) -> float:
        """Distance between neighbouring points; if it differs between directions, the smaller one."""

    @abstractmethod
    def patches(self) -> list[Patch]:
        """Return the print as seen from the front; a patch covers earlier patches."""

    @abstractmethod
    def detect(self, image: np.ndarray) -> TargetView:
        """Find the points in an image (H, W) of uint8 or uint16.

        Raises
        ------
        ImageError
            The image is not a grey image of 8 or 16 bit.
        TargetError
            The target is not found, or in too small a part; the message states the missing part.
        """

    @property
    def points_mm(self) -> np.ndarray:
        """All points (N, 3), target frame, in the order of `indices`."""
        return self.points_at(self.indices)

    @property
    def circle_diameter_mm(self) -> float | None:
        """Diameter of the circles whose centres are the points; None if the points are corners."""
        return None

    @property
    def extent_mm(self) -> np.ndarray:
        """Corners (4, 2), target frame, of the bounding rectangle of all points."""
        points = self.points_mm[:, :2]
        return rectangle_corners(points.min(axis=0), points.max(axis=0))

    @property
    def plate_mm(self) -> np.ndarray:
        """Corners (4, 2), target frame, of the flat rectangle: the pattern and the margin around it."""
        margin = np.broadcast_to(self.spacing_mm / 2 if self.margin_mm is None else self.margin_mm, 4)
        corners = self.extent_mm
        return rectangle_corners(corners.min(axis=0) - margin[:2], corners.max(axis=0) + margin[2:])

    def is_on_plate(self, places_mm: np.ndarray, *, beyond: float = 0.0) -> np.ndarray:
        """Return a mask (N,) of places (N, 2) in the target's plane that are on the flat plate; False for NaN.

        ``beyond`` enlarges the plate by this fraction of its size.
        """
        corners = self.plate_mm
        margin = beyond * np.ptp(corners, axis=0)
        low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
        return ((places_mm >= low) & (places_mm <= high)).all(axis=1)

    def is_findable(self, in_view: np.ndarray) -> bool:
        """Return True if `detect` finds the target from the points in view (N,), in the order of `indices`."""
        return bool(in_view.sum() >= max(min(_FEWEST_POINTS, len(in_view)), _SMALLEST_SHARE * len(in_view)))


_KINDS: dict[str, type[Target]] = {}


def lattice_indices(columns: int, rows: int) -> np.ndarray:
    """Return indices (columns * rows, 2) int64 (column, row) of a rectangular lattice, row by row."""
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=2).reshape(-1, 2)


def rectangle_corners(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return the corners (4, 2) of a rectangle from two opposite corners (2,)."""
    return np.array([first, (last[0], first[1]), last, (first[0], last[1])])


def parse_target(mapping: Mapping[str, object]) -> Target:
    """Create a target description from keys and values, as read from a file; DescriptionError if they are wrong."""
    if not isinstance(mapping, Mapping):
        raise DescriptionError(f"the target is a {type(mapping).__name__}; expected a table of keys and values")
    kind = mapping.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        found = f"found {kind!r}" if "kind" in mapping else "kind is missing"
        raise DescriptionError(
            f"the target cannot be read: {found} (kind is one of {', '.join(map(repr, sorted(_KINDS)))})"
        )
    try:
        return _KINDS[kind].model_validate(dict(mapping))
    except ValidationError as error:
        lines = [_explain_problem(problem) for problem in error.errors()]
        raise DescriptionError("the target cannot be read: " + "; ".join(lines)) from error


def _explain_problem(problem: Any) -> str:
    name = ".".join(str(part) for part in problem["loc"])
    text = problem["msg"].removeprefix("Value error, ")
    match problem["type"]:
        case "extra_forbidden":
            return f"{name} is not a key of this kind of target"
        case "missing":
            return f"{name} is missing"
        case _:
            return f"{name}: {text}, found {problem['input']!r}" if name else text
