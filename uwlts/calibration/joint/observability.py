"""Uncertainty of points and lengths over the covered volume, and weakly determined parameter combinations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.parameters import ViewMedium
from uwlts.calibration.joint.stored_estimate import StoredEstimate, read_original_estimate, require_joint
from uwlts.errors import CalibrationError
from uwlts.fitting.next_observation import CovarianceRoot
from uwlts.model.calibration import Calibration
from uwlts.model.parameter_keys import ParameterInFile, ParameterKey
from uwlts.model.sensor import Medium

_ROWS = 7  # depths of a mesh, which has 1953 lengths between points in all parts of a region
_COLUMNS = 9  # positions of a mesh along the stripe
_INSET = 0.02  # fraction of the depth omitted at either end, where an outline may be a point
_LEAST_MM = 1.0  # smallest useful extent of a region


@dataclass(frozen=True, eq=False)
class SheetRegion:
    """Region of the sheet that evidence covers, in a named medium, with its view.

    ``outline_mm`` (K, 2) is convex, Y and Z in the OCS. ``camera_depth_mm`` (2,) contains the smallest and largest
    depth along the camera's axis from its entrance pupil. ``points`` is the number of stripe pixels in the region.
    """

    name: str
    medium: Medium
    view: ViewMedium
    outline_mm: np.ndarray
    camera_depth_mm: np.ndarray
    points: int

    def has_area(self) -> bool:
        """Return whether the region extends by more than a millimetre in Y and in Z."""
        return bool(len(self.outline_mm) > 2 and np.ptp(self.outline_mm, axis=0).min() > _LEAST_MM)

    def width_at(self, depth_mm: float) -> tuple[float, float]:
        """Return the smallest and largest Y at a depth Z in the region."""
        start, end = self.outline_mm, np.roll(self.outline_mm, -1, axis=0)
        low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
        crossed = (low <= depth_mm) & (depth_mm <= high) & (high > low)
        a, b = start[crossed], end[crossed]
        across = a[:, 0] + (b[:, 0] - a[:, 0]) * (depth_mm - a[:, 1]) / (b[:, 1] - a[:, 1])
        return float(across.min()), float(across.max())

    def mesh(self, rows: int = _ROWS, columns: int = _COLUMNS) -> np.ndarray:
        """Return points (rows, columns, 2), Y and Z in mm: each row at one depth, from side to side."""
        low, high = self.outline_mm[:, 1].min(), self.outline_mm[:, 1].max()
        inset = _INSET * (high - low)
        depths = np.linspace(low + inset, high - inset, rows)
        return np.stack(
            [np.column_stack([np.linspace(*self.width_at(z), columns), np.full(columns, z)]) for z in depths]
        )


@dataclass(frozen=True, eq=False)
class SheetSamples:
    """Points of the sheet at Y and Z (N, 2) of the OCS, mm, and derivatives.

    The derivatives are ``by_parameters`` (N, 3, P), and ``by_px`` (N, 3) for one pixel across the stripe.
    """

    at_mm: np.ndarray
    by_parameters: np.ndarray
    by_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Lengths:
    """Lengths (M,) between points of the sheet, with Y and Z of both ends (M, 2, 2).

    The derivatives are ``by_parameters`` (M, P), and ``by_px`` (M,) for independent pixel noise at both ends.
    """

    ends_mm: np.ndarray
    length_mm: np.ndarray
    by_parameters: np.ndarray
    by_px: np.ndarray

    def std_mm(self, covariance: np.ndarray, *, noise_px: float = 0.0) -> np.ndarray:
        """Return the standard uncertainty (M,) in mm for a covariance (P, P) of the parameters and stripe noise."""
        variance = np.sum((self.by_parameters @ covariance) * self.by_parameters, axis=1)
        return np.sqrt(np.maximum(variance, 0.0) + (noise_px * self.by_px) ** 2)


def list_regions(calibration: Calibration) -> list[SheetRegion]:
    """Return the regions that a joint calibration's evidence covers, that of its medium of use first.

    Raises CalibrationError if the covered volume is damaged.
    """
    found = []
    for covered in require_joint(calibration).covered:
        number = covered.medium
        if number is not None and number >= len(calibration.media):
            raise CalibrationError(f"the calibration's covered volume is damaged: it has no medium number {number}")
        medium = Medium(kind="air") if number is None else calibration.media[number].medium
        outline, depth = np.array(covered.outline_mm).reshape(-1, 2), np.array(covered.camera_depth_mm)
        found.append(
            SheetRegion(covered.name, medium, ViewMedium(covered.window, number), outline, depth, covered.point_count)
        )
    return sorted(found, key=lambda region: (region.view.medium is None, -region.points))


def read_region_estimate(calibration: Calibration, region: SheetRegion) -> StoredEstimate:
    """Return the joint estimate for the view of a region; errors as `read_original_estimate`."""
    return replace(read_original_estimate(calibration, region.medium), view=region.view)


def sample_sheet(known: StoredEstimate, at_mm: np.ndarray) -> SheetSamples:
    """Return points of the sheet at Y and Z (N, 2) of the OCS.

    Raises CalibrationError if a point is outside the camera's view.
    """
    pixels, across = project_sheet_points(known, at_mm), known.across()
    found = known.triangulate(pixels[:, 1 - across], pixels[:, across]) if np.isfinite(pixels).all() else None
    if found is None:
        raise CalibrationError("the calibration's covered volume is outside the camera's view: calibrate again")
    return SheetSamples(at_mm, found[1][:, :, 1:], found[1][:, :, 0])


def project_sheet_points(known: StoredEstimate, at_mm: np.ndarray) -> np.ndarray:
    """Return pixels (N, 2) of points at Y and Z (N, 2) of the OCS; NaN if the camera does not see them."""
    transform = known.calibration.object_transform()
    return known.project(at_mm @ transform[:3, 1:3].T + transform[:3, 3])


def compute_lengths(points: SheetSamples, start: np.ndarray, end: np.ndarray) -> Lengths:
    """Return lengths between points, given by their numbers (M,)."""
    difference = points.at_mm[end] - points.at_mm[start]
    length = np.linalg.norm(difference, axis=1)
    unit = difference / length[:, None]
    moved = points.by_parameters[end, 1:] - points.by_parameters[start, 1:]
    by_px = [np.einsum("mi,mi->m", unit, points.by_px[side, 1:]) for side in (start, end)]
    ends = np.stack([points.at_mm[start], points.at_mm[end]], axis=1)
    return Lengths(ends, length, np.einsum("mi,mip->mp", unit, moved), np.hypot(*by_px))


def compute_mesh_lengths(known: StoredEstimate, region: SheetRegion) -> Lengths:
    """Return lengths between all pairs of points of a region's mesh."""
    at = region.mesh().reshape(-1, 2)
    return compute_lengths(sample_sheet(known, at), *np.triu_indices(len(at), k=1))


_NEGLIGIBLE_MM = 1e-3  # far below the noise of a scanned point
_AXIS_COSINE = 0.9  # within 26 deg, a length is along an axis
_MOST = 3  # largest number of parameters or directions to list
_LEAST_SHARE = 0.1  # fraction of the variance of all lengths; a direction with less is not listed
_NAMED_SHARE = 0.4  # fraction of the most important parameter's contribution; others are not listed with it
_CAUSE_SHARE = 0.3  # fraction of a direction that knowledge of one parameter must determine to count as its cause
_CONFUSED = 0.3  # smallest correlation eigenvalue below which parameters are inseparable: correlation of 0.7 for two


@dataclass(frozen=True)
class Weakness:
    """Weakly determined direction in parameter space, with its main parameters, the most important first.

    ``confused`` says whether the evidence cannot separate these parameters. ``cost_mm`` is the standard uncertainty
    that the direction adds to the length that it changes most. This length is ``along`` "Y", "Z" or "Y and Z", and its
    deeper end is at the depth Z ``depth_mm`` of the OCS.
    """

    parameters: tuple[ParameterInFile, ...]
    confused: bool
    cost_mm: float
    length_mm: float
    along: str
    depth_mm: float

    def words(self) -> str:
        """Describe the weakness, without a full stop."""
        names = [key.quantity.words for key in self.parameters]
        what = f"{self.cost_mm:.3f} mm in a length of {self.length_mm:.0f} mm along {self.along}"
        if len(names) == 1:
            return f"{names[0]} is not known well enough; this adds {what}"
        why = "cannot be separated by these images" if self.confused else "are not known well enough"
        return f"{', '.join(names[:-1])} and {names[-1]} {why}; together they add {what}"


def find_weaknesses(lengths: Lengths, keys: Sequence[ParameterKey], covariance: np.ndarray) -> list[Weakness]:
    """Return at most three weakest directions; empty if every length is certain to a micrometre.

    A direction is an independent change of the parameters by one standard deviation. It is omitted if it adds less than
    a tenth of the variance of all lengths. ``lengths`` are those over the volume; ``covariance`` is (P, P).
    """
    root, std, found = CovarianceRoot.from_covariance(covariance).root, np.sqrt(np.diag(covariance)), []
    _, sizes, parts = np.linalg.svd(lengths.by_parameters @ root, full_matrices=False)
    for size, part in zip(sizes[:_MOST], parts, strict=False):
        direction = root @ part
        changes = np.abs(lengths.by_parameters @ direction)
        worst = int(np.argmax(changes))
        if size**2 < _LEAST_SHARE * np.sum(sizes**2) or changes[worst] < _NEGLIGIBLE_MM:
            break
        named = _select_main_parameters(lengths.by_parameters, direction, std)
        correlation = covariance[np.ix_(named, named)] / np.outer(std[named], std[named])
        start, end = lengths.ends_mm[worst]
        along_y, along_z = np.abs(end - start) / np.linalg.norm(end - start) > _AXIS_COSINE
        found.append(
            Weakness(
                parameters=tuple(keys[place] for place in named),
                confused=len(named) > 1 and bool(np.linalg.eigvalsh(correlation)[0] < _CONFUSED),
                cost_mm=float(changes[worst]),
                length_mm=float(lengths.length_mm[worst]),
                along="Z" if along_z else "Y" if along_y else "Y and Z",
                depth_mm=float(max(start[1], end[1])),
            )
        )
    return found


def _select_main_parameters(by_parameters: np.ndarray, direction: np.ndarray, std: np.ndarray) -> list[int]:
    """Return the numbers of at most three main parameters of a direction (P,), the most important first.

    The squared correlation of a parameter with the direction is the fraction of its variance that knowledge of the
    parameter would remove. This includes parameters without an effect, such as a step height on lengths. If no single
    parameter would help, the parameters with the largest effect on the lengths are returned.
    """
    share = np.divide(direction**2, std**2, out=np.zeros_like(std), where=std > 0)
    if share.max() < _CAUSE_SHARE:
        share = np.linalg.norm(by_parameters, axis=0) * np.abs(direction)
    return [int(place) for place in np.argsort(-share) if share[place] >= _NAMED_SHARE * share.max()][:_MOST]


def format_weaknesses(found: Sequence[Weakness]) -> list[str]:
    """Describe weaknesses; an empty list gives one sentence."""
    if not found:
        return ["no weakly determined parameter changes a length over the volume by more than 0.001 mm"]
    return [weakness.words() for weakness in found]
