"""Uncertainty of points and lengths over the covered volume, and the directions that the evidence leaves open."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.derivatives import COLUMNS
from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.stored_estimate import StoredEstimate, found_estimate, require_joint
from uwlts.model.calibration import Calibration
from uwlts.model.errors import CalibrationError
from uwlts.model.joint_estimate import CoveredRegion
from uwlts.model.parameter_keys import ParameterInFile, ParameterKey
from uwlts.model.sensor import Medium
from uwlts.optics.camera import project_through_window

_ROWS, _COLUMNS = 7, 9  # of a mesh: 1953 lengths, between ends in all parts of a region
_INSET = 0.02  # share of the depth left out at either end, where an outline may come to a point
_LEAST_MM = 1.0  # extent of a region over which lengths mean something


@dataclass(frozen=True, eq=False)
class Region:
    """A region of the sheet that evidence covers.

    Attributes
    ----------
    name : of the medium
    view : through what it was seen
    outline_mm : (K, 2); convex, Y and Z in the OCS
    camera_depth_mm : (2,); nearest and farthest depth along the camera's axis, from its entrance pupil
    points : stripe pixels in it
    """

    name: str
    medium: Medium
    view: View
    outline_mm: np.ndarray
    camera_depth_mm: np.ndarray
    points: int

    def has_area(self) -> bool:
        """Whether it extends by more than a millimetre in Y and in Z."""
        return bool(len(self.outline_mm) > 2 and np.ptp(self.outline_mm, axis=0).min() > _LEAST_MM)

    def width_at(self, depth_mm: float) -> tuple[float, float]:
        """Least and largest Y at a depth Z within it."""
        start, end = self.outline_mm, np.roll(self.outline_mm, -1, axis=0)
        low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
        crossed = (low <= depth_mm) & (depth_mm <= high) & (high > low)
        a, b = start[crossed], end[crossed]
        across = a[:, 0] + (b[:, 0] - a[:, 0]) * (depth_mm - a[:, 1]) / (b[:, 1] - a[:, 1])
        return float(across.min()), float(across.max())

    def mesh(self, rows: int = _ROWS, columns: int = _COLUMNS) -> np.ndarray:
        """Points (rows, columns, 2), Y and Z in mm: each row at one depth, from one side to the other."""
        low, high = self.outline_mm[:, 1].min(), self.outline_mm[:, 1].max()
        inset = _INSET * (high - low)
        depths = np.linspace(low + inset, high - inset, rows)
        return np.stack(
            [np.column_stack([np.linspace(*self.width_at(z), columns), np.full(columns, z)]) for z in depths]
        )


@dataclass(frozen=True, eq=False)
class SheetPoints:
    """Points of the sheet and how they move, OCS, mm.

    Attributes
    ----------
    at_mm : (N, 2); Y and Z
    by_parameters : (N, 3, P)
    by_px : (N, 3); for one pixel across the stripe
    """

    at_mm: np.ndarray
    by_parameters: np.ndarray
    by_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Lengths:
    """Lengths between points of the sheet.

    Attributes
    ----------
    ends_mm : (M, 2, 2); Y and Z of both ends
    length_mm : (M,)
    by_parameters : (M, P)
    by_px : (M,); for a pixel's noise at each end, independent of the other's
    """

    ends_mm: np.ndarray
    length_mm: np.ndarray
    by_parameters: np.ndarray
    by_px: np.ndarray

    def std_mm(self, covariance: np.ndarray, *, noise_px: float = 0.0) -> np.ndarray:
        """Standard uncertainty (M,) in mm for a covariance (P, P) of the parameters and noise of each stripe centre."""
        variance = np.sum((self.by_parameters @ covariance) * self.by_parameters, axis=1)
        return np.sqrt(np.maximum(variance, 0.0) + (noise_px * self.by_px) ** 2)


def regions(calibration: Calibration) -> list[Region]:
    """The regions that a joint calibration's evidence covers, that of its use first; CalibrationError if damaged."""
    found = [_region(calibration, entry) for entry in require_joint(calibration).covered]
    return sorted(found, key=lambda region: (region.view.medium is None, -region.points))


def _region(calibration: Calibration, covered: CoveredRegion) -> Region:
    number = covered.medium
    if number is not None and number >= len(calibration.media):
        raise CalibrationError(f"the calibration's covered volume is damaged: it has no medium number {number}")
    return Region(
        name=covered.name,
        medium=Medium(kind="air") if number is None else calibration.media[number].medium,
        view=View(covered.window, number),
        outline_mm=np.array(covered.outline_mm, dtype=np.float64).reshape(-1, 2),
        camera_depth_mm=np.array(covered.camera_depth_mm, dtype=np.float64),
        points=covered.point_count,
    )


def estimate_in(calibration: Calibration, region: Region) -> StoredEstimate:
    """The joint estimate as found, for what is seen as a region was; CalibrationError as `found_estimate`."""
    return replace(found_estimate(calibration, region.medium), view=region.view)


def points_at(calibration: Calibration, known: StoredEstimate, at_mm: np.ndarray) -> SheetPoints:
    """Points of the sheet at Y and Z (N, 2) of the OCS, with their derivatives.

    Raises CalibrationError: the camera does not see one of them.
    """
    transform = calibration.object_transform()
    pixels = pixels_at(calibration, known, at_mm)
    points = known.parameters.on_sheet(known.values, known.view, pixels) if np.isfinite(pixels).all() else None
    if points is None:
        raise CalibrationError("the calibration's covered volume lies outside the camera's view: calibrate again")
    by = np.stack(
        [
            known.parameters.by_global(points.by_rays[:, axis], known.view, points.by_sheet[:, axis])
            for axis in range(3)
        ],
        axis=1,
    )
    across = COLUMNS.index("v" if calibration.stripe_along == "width" else "u")
    into_object = transform[:3, :3].T
    return SheetPoints(at_mm, np.einsum("ij,njp->nip", into_object, by), points.by_rays[across].T @ into_object.T)


def pixels_at(calibration: Calibration, known: StoredEstimate, at_mm: np.ndarray) -> np.ndarray:
    """Where the camera sees points at Y and Z (N, 2) of the OCS: (N, 2), NaN where it does not."""
    transform, parameters = calibration.object_transform(), known.parameters
    in_camera = at_mm @ transform[:3, 1:3].T + transform[:3, 3]
    window = parameters.window_model(known.values) if known.view.window else None
    index = parameters.medium_index(known.values, known.view)
    return project_through_window(parameters.camera(known.values), window, in_camera, medium_index=index)


def lengths_between(points: SheetPoints, start: np.ndarray, end: np.ndarray) -> Lengths:
    """Lengths from points to others by their numbers (M,)."""
    apart = points.at_mm[end] - points.at_mm[start]
    length = np.linalg.norm(apart, axis=1)
    unit = apart / length[:, None]
    moved = points.by_parameters[end, 1:] - points.by_parameters[start, 1:]
    by_px = [np.einsum("mi,mi->m", unit, points.by_px[side, 1:]) for side in (start, end)]
    return Lengths(
        ends_mm=np.stack([points.at_mm[start], points.at_mm[end]], axis=1),
        length_mm=length,
        by_parameters=np.einsum("mi,mip->mp", unit, moved),
        by_px=np.hypot(*by_px),
    )


def lengths_over(calibration: Calibration, known: StoredEstimate, region: Region) -> Lengths:
    """Lengths between all pairs of points of a region's mesh."""
    at = region.mesh().reshape(-1, 2)
    return lengths_between(points_at(calibration, known, at), *np.triu_indices(len(at), k=1))


_MOST = 3  # more than a reader keeps in mind are not named
_LEAST_SHARE = 0.1  # of the variance of all lengths; a direction that adds less is not named
_NAMED_SHARE = 0.4  # of the most important parameter's; others are not named with it
_CAUSE_SHARE = 0.3  # of a direction that knowing one parameter must close to count as its cause
_CONFUSED = 0.3
"""Smallest eigenvalue of the correlation of two parameters or more that cannot be separated: 0.7 for two."""
_NEGLIGIBLE_MM = 1e-3  # far below the noise of a scanned point
_AXIS_COSINE = 0.9  # within 26 deg a length runs along an axis


@dataclass(frozen=True)
class Weakness:
    """A direction that the evidence leaves open.

    Attributes
    ----------
    parameters : those that make it up, the most important first
    confused : whether the evidence cannot separate them, rather than knows each too little
    cost_mm : standard uncertainty that it adds to the length that it changes most
    length_mm : that length
    along : which way it runs: "Y", "Z" or "Y and Z"
    depth_mm : largest depth Z of its ends, OCS
    """

    parameters: tuple[ParameterInFile, ...]
    confused: bool
    cost_mm: float
    length_mm: float
    along: str
    depth_mm: float

    def words(self) -> str:
        """The weakness as a sentence without its full stop."""
        names = [key.quantity.words for key in self.parameters]
        listed = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
        what = f"{self.cost_mm:.3f} mm in a length of {self.length_mm:.0f} mm along {self.along}"
        if len(names) == 1:
            return f"{listed} is known too little; it costs {what}"
        if self.confused:
            return f"{listed} cannot be separated by these images; together they cost {what}"
        return f"{listed} are known too little; together they cost {what}"


def weaknesses(lengths: Lengths, keys: Sequence[ParameterKey], covariance: np.ndarray) -> list[Weakness]:
    """The directions that cost most, at most three; none where no length becomes uncertain by a micrometre.

    Parameters
    ----------
    lengths : over the volume
    covariance : (P, P)
    """
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    _, sizes, parts = np.linalg.svd(lengths.by_parameters @ root, full_matrices=False)
    total = float(np.sum(sizes**2))
    found = []
    for size, part in zip(sizes[:_MOST], parts, strict=False):
        direction = root @ part
        changes = lengths.by_parameters @ direction
        worst = int(np.argmax(np.abs(changes)))
        if size**2 < _LEAST_SHARE * total or abs(changes[worst]) < _NEGLIGIBLE_MM:
            break
        named = _named(lengths, direction, std)
        start, end = lengths.ends_mm[worst]
        found.append(
            Weakness(
                parameters=tuple(keys[place] for place in named),
                confused=len(named) > 1 and _confused(covariance, named),
                cost_mm=float(abs(changes[worst])),
                length_mm=float(lengths.length_mm[worst]),
                along=_way(end - start),
                depth_mm=float(max(start[1], end[1])),
            )
        )
    return found


def format_weaknesses(found: Sequence[Weakness]) -> list[str]:
    """Weaknesses as sentences; that there are none is one."""
    if not found:
        return ["nothing that these images leave open changes a length over the volume by more than 0.001 mm"]
    return [weakness.words() for weakness in found]


def _named(lengths: Lengths, direction: np.ndarray, std: np.ndarray) -> list[int]:
    """Numbers of the parameters that make up a direction (P,), at most three, the most important first.

    Those count whose knowledge would close the direction: the share of it that goes with a parameter is the square of
    their correlation. A parameter that moves no point, such as the height of a step, may be the cause as well. Where
    knowing one would not help, many trade places, and those count that change lengths most.
    """
    share = np.divide(direction**2, std**2, out=np.zeros_like(std), where=std > 0)
    if share.max() < _CAUSE_SHARE:
        share = np.linalg.norm(lengths.by_parameters, axis=0) * np.abs(direction)
    return [int(place) for place in np.argsort(-share) if share[place] >= _NAMED_SHARE * share.max()][:_MOST]


def _confused(covariance: np.ndarray, named: Sequence[int]) -> bool:
    part = covariance[np.ix_(named, named)]
    std = np.sqrt(np.diag(part))
    return bool(np.linalg.eigvalsh(part / np.outer(std, std))[0] < _CONFUSED)


def _way(apart: np.ndarray) -> str:
    across, along = np.abs(apart) / np.linalg.norm(apart)
    return "Z" if along > _AXIS_COSINE else "Y" if across > _AXIS_COSINE else "Y and Z"
