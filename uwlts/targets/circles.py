"""Circle targets: a lattice numbered from three circles with a dot, and grids without marks."""

from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from uwlts.errors import TargetError
from uwlts.model.sensor import Positive
from uwlts.targets.target import Patch, Target, TargetView, lattice_indices

if TYPE_CHECKING:
    from uwlts.targets.detection import Ellipses, Lattice

Place = tuple[int, int]

_MIN_MARK_STRENGTH = 0.3
"""Least strength of a mark above the median of all circles. This median is negative if blur lowers the ring of small
circles. A sharp dot has strength 1, dirt and noise rarely more than 0.1, a blurred dot of two pixels 0.4."""
_MAX_OUTLIERS = 0.02  # largest fraction of circles outside the described lattice, which are outliers
_QUARTER_TURNS = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
"""Rotations from the target's axes to those of the indices. The target is seen from the front: no reflections."""


class CircleTarget(Target):
    """A lattice of equal circles, three of them with a central dot of the opposite brightness.

    The origin is the centre of the circle at `origin`. Circles may be bright on dark or dark on bright.

    Attributes
    ----------
    spacing_x_mm, spacing_y_mm : distance between the centres of neighbours along X and along Y
    diameter_mm, marker_diameter_mm : diameter of the circles and of the dots
    columns, rows : number of circles along X and along Y
    origin : place (column, row) of the first dotted circle, counted from the top left circle (0, 0)
    marker_x, marker_y : places of the dotted circles in +X and in +Y direction, counted from `origin`
    """

    kind: Literal["circles"] = "circles"
    spacing_x_mm: Positive = 9.375
    spacing_y_mm: Positive = 9.372
    diameter_mm: Positive
    marker_diameter_mm: Positive
    columns: Annotated[int, Field(ge=2)]
    rows: Annotated[int, Field(ge=2)]
    origin: Place
    marker_x: Place = (2, 0)
    marker_y: Place = (0, 2)

    @model_validator(mode="after")
    def _check_consistent(self) -> Self:
        if self.diameter_mm >= min(self.spacing_x_mm, self.spacing_y_mm):
            raise ValueError(
                f"diameter_mm is {self.diameter_mm}; expected less than the spacing of {self.spacing_x_mm} x "
                f"{self.spacing_y_mm} mm, otherwise the circles touch"
            )
        if self.marker_diameter_mm >= self.diameter_mm:
            raise ValueError(
                f"marker_diameter_mm is {self.marker_diameter_mm}; expected less than diameter_mm, {self.diameter_mm}"
            )
        for name, (i, j) in zip(("origin", "marker_x", "marker_y"), self.marked(), strict=True):
            if not (0 <= i < self.columns and 0 <= j < self.rows):
                raise ValueError(
                    f"{name} is at ({i}, {j}); expected a place of the {self.columns} x {self.rows} lattice"
                )
        if self.marker_x[0] * self.marker_y[1] == self.marker_x[1] * self.marker_y[0]:
            raise ValueError(
                f"marker_x {self.marker_x} and marker_y {self.marker_y} are collinear with the origin; "
                "expected two directions, which determine the orientation of the target"
            )
        return self

    @property
    def indices(self) -> np.ndarray:
        return lattice_indices(self.columns, self.rows)

    def points_at(self, indices: np.ndarray) -> np.ndarray:
        steps = (indices - np.array(self.origin)) * (self.spacing_x_mm, self.spacing_y_mm)
        return np.column_stack([steps, np.zeros(len(steps))])

    @property
    def spacing_mm(self) -> float:
        return min(self.spacing_x_mm, self.spacing_y_mm)

    @property
    def circle_diameter_mm(self) -> float | None:
        return self.diameter_mm

    def marked(self) -> list[Place]:
        """Return the places of the three dotted circles: origin, in +X, in +Y."""
        return [(self.origin[0] + i, self.origin[1] + j) for i, j in ((0, 0), self.marker_x, self.marker_y)]

    def is_findable(self, in_view: np.ndarray) -> bool:
        return super().is_findable(in_view) and all(in_view[j * self.columns + i] for i, j in self.marked())

    def patches(self) -> list[Patch]:
        dots = self.points_at(np.array(self.marked()))
        return [disc(point, self.diameter_mm) for point in self.points_mm] + [
            disc(point, self.marker_diameter_mm, ink=False) for point in dots
        ]

    def detect(self, image: np.ndarray) -> TargetView:
        # Imported late: a description does not need the detector.
        from uwlts.targets.detection import detect_lattice

        return detect_lattice(image, partial(self._read_lattice, image))

    def _read_lattice(self, image: np.ndarray, lattice: "Lattice") -> TargetView:
        """Return the view of the target in a lattice of circles of an image (H, W)."""
        # Imported late: a description does not need the detector.
        from uwlts.targets.detection import measure_marks

        circles, numbers = lattice.circles, lattice.indices
        strength = measure_marks(image, circles, mark_over_circle=self.marker_diameter_mm / self.diameter_mm)
        origin, turn = _find_orientation(numbers, strength - np.median(strength), self, lattice.found)
        indices = (numbers - origin) @ turn + np.array(self.origin)
        places = (self.columns, self.rows)
        inside = ((indices >= 0) & (indices < places)).all(1)
        outside = np.count_nonzero(~inside)
        if outside > _MAX_OUTLIERS * len(indices):
            low, high = indices.min(0), indices.max(0)
            exchanged = (indices - np.array(self.origin))[:, ::-1] + np.array(self.origin)
            advice = "check columns, rows and origin"
            if ((exchanged >= 0) & (exchanged < places)).all():
                advice = "they fit with columns and rows exchanged, as in a mirrored image"
            raise TargetError(
                f"found circles from place ({low[0]}, {low[1]}) to ({high[0]}, {high[1]}), {outside} of {len(indices)} "
                f"outside the described {self.columns} x {self.rows}; {advice}"
            )
        return collect_circles(self, circles[inside], indices[inside])


def collect_circles(target: Target, circles: "Ellipses", indices: np.ndarray) -> TargetView:
    """Return the view of a target from the images (N) of its circles and their indices (N, 2), sorted by row."""
    order = np.lexsort((indices[:, 0], indices[:, 1]))
    circles, indices = circles[order], indices[order]
    return TargetView(
        pixels=circles.centres,
        points_mm=target.points_at(indices),
        indices=indices,
        quality={
            "residual_px": circles.residual_px,
            "contrast": circles.contrast,
            "sharpness": circles.sharpness,
            "radius_px": np.sqrt(np.linalg.det(circles.shapes)),
        },
    )


def disc(point: np.ndarray, diameter_mm: float, *, ink: bool = True) -> Patch:
    """Return the print of a circle at a point (3,) of the target."""
    (x, y), radius = point[:2].tolist(), diameter_mm / 2
    return Patch(x - radius, y - radius, x + radius, y + radius, round=True, ink=ink)


def _find_orientation(
    numbers: np.ndarray, strength: np.ndarray, target: CircleTarget, found: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (2,) of the origin circle and the rotation (2, 2) from target steps to index steps."""
    marked = {
        tuple(n): value for n, value in zip(numbers.tolist(), strength, strict=True) if value > _MIN_MARK_STRENGTH
    }
    fits = []
    for number in marked:
        for turn in _QUARTER_TURNS:
            others = [tuple((np.array(number) + turn @ step).tolist()) for step in (target.marker_x, target.marker_y)]
            if all(other in marked for other in others):
                fits.append((np.array(number), turn))
    if len(fits) == 1:
        return fits[0]
    seen = f"found {found} circles, {len(numbers)} of them in a lattice"
    if len(marked) < 3:
        raise TargetError(
            f"{seen}, but only {len(marked)} of 3 marked circles; all three must be in view, sharp and unobstructed"
        )
    raise TargetError(
        f"{seen}, with {len(marked)} marked circles, which match the described offsets {target.marker_x} and "
        f"{target.marker_y} {len(fits)} times; expected once: check marker_x, marker_y and dirt on the circles"
    )


_FEWEST = 0.75
"""Least fraction of the circles that must be found: dirt hides single ones; with fewer, the grid is another one."""
_MOST_OTHERS = 0.02  # largest fraction of found circles outside the described grid: more are another grid


class CircleGridTarget(Target):
    """Equal circles without marks, as `cv2.findCirclesGrid` finds them; all its sides must be in view.

    The origin is the centre of the top left circle. Circles may be bright on dark or dark on bright. A rectangular
    grid, and an asymmetric one with an even number of rows, look the same after half a turn, square ones after a
    quarter turn. Of these, the orientation with X pointing most to the right in the image is used.
    """

    kind: Literal["circle grid"] = "circle grid"
    # Number of circles in a row, and number of rows (OpenCV's pattern size).
    columns: Annotated[int, Field(ge=2)]
    rows: Annotated[int, Field(ge=2)]
    pitch_mm: Positive | tuple[Positive, Positive]
    """Distance between neighbours along X and along Y, or these distances [along X, along Y]. In an asymmetric grid,
    it is the distance between rows, and half the distance between the circles of a row."""
    diameter_mm: Positive  # diameter of the circles
    asymmetric: bool = False
    """True if every second row, from the second one on, is shifted by half the distance of its circles (OpenCV's
    CALIB_CB_ASYMMETRIC_GRID)."""

    @model_validator(mode="after")
    def _check_consistent(self) -> Self:
        if self.asymmetric and isinstance(self.pitch_mm, tuple):
            raise ValueError(f"pitch_mm is {self.pitch_mm}; expected one number for an asymmetric grid")
        if self.diameter_mm >= self.spacing_mm:
            raise ValueError(
                f"diameter_mm is {self.diameter_mm}; expected less than the distance of neighbouring circles, "
                f"{self.spacing_mm:.4g} mm, otherwise the circles touch"
            )
        return self

    @property
    def indices(self) -> np.ndarray:
        indices = lattice_indices(self.columns, self.rows)
        if self.asymmetric:
            indices[:, 0] = 2 * indices[:, 0] + indices[:, 1] % 2
        return indices

    def points_at(self, indices: np.ndarray) -> np.ndarray:
        return np.column_stack([indices * np.full(2, self.pitch_mm), np.zeros(len(indices))])

    @property
    def spacing_mm(self) -> float:
        return float(np.min(self.pitch_mm)) * (2.0**0.5 if self.asymmetric else 1.0)

    @property
    def circle_diameter_mm(self) -> float | None:
        return self.diameter_mm

    def is_findable(self, in_view: np.ndarray) -> bool:
        return bool(in_view.all())

    def patches(self) -> list[Patch]:
        return [disc(point, self.diameter_mm) for point in self.points_mm]

    def detect(self, image: np.ndarray) -> TargetView:
        # Imported late: a description does not need the detector.
        from uwlts.targets.detection import detect_lattice

        return detect_lattice(image, self._read_lattice)

    def _read_lattice(self, lattice: "Lattice") -> TargetView:
        """Return the view of the target in a lattice of circles."""
        numbers = lattice.indices
        if self.asymmetric:
            # Nearest neighbours are along the diagonals of rows and columns.
            numbers = np.column_stack([numbers[:, 0] - numbers[:, 1], numbers[:, 0] + numbers[:, 1]])
        indices = self._place(numbers, lattice.circles.centres, lattice.found)
        described = set(map(tuple, self.indices.tolist()))
        inside = np.array([tuple(index) in described for index in indices.tolist()])
        return collect_circles(self, lattice.circles[inside], indices[inside])

    def _place(self, numbers: np.ndarray, centres: np.ndarray, found: int) -> np.ndarray:
        """Return the indices (N, 2) of numbered circles, by the only turn and shift that fits most of them."""
        # Imported late: a description does not need it.
        from scipy.signal import fftconvolve

        here, fits = _make_mask(self.indices), []
        for _ in range(4):
            numbers = np.column_stack([-numbers[:, 1], numbers[:, 0]])
            low = numbers.min(axis=0)
            # Element s of the correlation counts the circles in the grid after a shift by s.
            counts = np.rint(fftconvolve(here, _make_mask(numbers - low)[::-1, ::-1])).astype(int)
            shifts = np.argwhere(counts == counts.max()) - (np.ptp(numbers, axis=0))
            fits.append((int(counts.max()), [numbers - low + shift for shift in shifts]))
        most = max(count for count, _ in fits)
        best = [places for count, places in fits if count == most]
        if most < _FEWEST * len(self.indices) or len(numbers) - most > _MOST_OTHERS * len(numbers):
            kind = "an asymmetric" if self.asymmetric else "a rectangular"
            raise TargetError(
                f"found {found} circles, {len(numbers)} of them in a lattice; of these, {most} fit {kind} grid of "
                f"{self.columns} x {self.rows} circles: check columns, rows and asymmetric, and that the whole grid is "
                "in view"
            )
        if any(len(places) > 1 for places in best):
            raise TargetError(
                f"found {most} of {self.columns} x {self.rows} circles, which fit the grid at several places: without "
                "marks, all its sides must be in view"
            )
        return max((places[0] for places in best), key=lambda indices: _find_direction(indices, centres))


def _make_mask(places: np.ndarray) -> np.ndarray:
    """Return an array that is 1 at these places (N, 2), counted from 0, and 0 elsewhere."""
    mask = np.zeros(places.max(axis=0) + 1)
    mask[tuple(places.T)] = 1.0
    return mask


def _find_direction(indices: np.ndarray, centres: np.ndarray) -> float:
    """Return the mean step in the image to the right, px, from a column to the next."""
    return float(np.linalg.lstsq(np.column_stack([indices, np.ones(len(indices))]), centres, rcond=None)[0][0, 0])
