"""Circle grids without marks: rectangular ones, and asymmetric ones whose rows are shifted by half their spacing."""

from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from uwlts.errors import TargetError
from uwlts.model.sensor import Positive
from uwlts.targets.circles import collect_circles, disc
from uwlts.targets.target import Patch, Target, TargetView, lattice_indices

if TYPE_CHECKING:
    from uwlts.targets.detection import Lattice

_FEWEST = 0.75
"""Least fraction of the circles that must be found: dirt hides single ones; with fewer, the grid is another one."""
_MOST_OTHERS = 0.02
"""Largest fraction of found circles outside the described grid: more are another grid."""


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
    def _consistent(self) -> Self:
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

        here, fits = _mask(self.indices), []
        for _ in range(4):
            numbers = np.column_stack([-numbers[:, 1], numbers[:, 0]])
            low = numbers.min(axis=0)
            # Element s of the correlation counts the circles in the grid after a shift by s.
            counts = np.rint(fftconvolve(here, _mask(numbers - low)[::-1, ::-1])).astype(int)
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
        return max((places[0] for places in best), key=lambda indices: _direction(indices, centres))


def _mask(places: np.ndarray) -> np.ndarray:
    """Return an array that is 1 at these places (N, 2), counted from 0, and 0 elsewhere."""
    mask = np.zeros(places.max(axis=0) + 1)
    mask[tuple(places.T)] = 1.0
    return mask


def _direction(indices: np.ndarray, centres: np.ndarray) -> float:
    """Return the mean step in the image to the right, px, from a column to the next."""
    return float(np.linalg.lstsq(np.column_stack([indices, np.ones(len(indices))]), centres, rcond=None)[0][0, 0])
