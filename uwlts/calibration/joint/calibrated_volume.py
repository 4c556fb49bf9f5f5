"""Uncertainty of lengths and points over the calibrated volume, and differences between two calibrations."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.observability import (
    Lengths,
    SheetRegion,
    compute_lengths,
    project_sheet_points,
    read_region_estimate,
    sample_sheet,
)
from uwlts.calibration.joint.residuals import STEP, STRIPE
from uwlts.calibration.joint.scanned_surfaces import SCANNED
from uwlts.calibration.joint.stored_estimate import StoredEstimate, require_joint
from uwlts.errors import CalibrationError
from uwlts.fitting.next_observation import CovarianceRoot
from uwlts.model.calibration import Calibration
from uwlts.model.parameter_keys import MediumIndex
from uwlts.model.sensor import Uncertainty
from uwlts.optics.triangulation import points_on_sheet

# Rows of the certificate's table, up to beyond the volume of usual sensors.
LENGTHS_MM = (10.0, 20.0, 50.0, 100.0, 150.0, 200.0, 300.0, 500.0)
# Number of positions along each axis searched for the largest uncertainty, which varies slowly over the volume.
_PLACES = 9
# Rows of the maps' mesh, along Z; finer meshes look the same.
_ROWS = 17
# Columns of the maps' mesh, along Y.
_COLUMNS = 21
_SHORT_SHARE = 0.25
"""Largest short length of the maps, relative to the smaller of the volume's depth and width."""


@dataclass(frozen=True)
class LengthUncertainty:
    """Expanded uncertainties (k = 2) in mm of a length along X, Y or Z, the largest in the volume.

    ``calibration_mm`` is the contribution of the calibration alone, as for points averaged over surfaces; along X, that
    of the stage. ``point_mm`` includes the noise of a single stripe centre at each end.
    """

    axis: str
    length_mm: float
    calibration_mm: float
    point_mm: float


@dataclass(frozen=True, eq=False)
class CalibrationInUse:
    """A joint estimate as used for measurements, in the region that it covers.

    ``covariance`` (P, P) includes the drift of the medium's index since calibration. ``noise_px`` is the standard
    deviation of a stripe centre.
    """

    calibration: Calibration
    region: SheetRegion
    known: StoredEstimate
    covariance: np.ndarray
    uncertainty: Uncertainty
    noise_px: float


def prepare_use(calibration: Calibration, region: SheetRegion) -> CalibrationInUse:
    """Return a joint calibration for measurements in one of its regions; CalibrationError if it is damaged."""
    known = read_region_estimate(calibration, region)
    uncertainty = calibration.origin().known_before
    covariance, keys = known.covariance.copy(), known.parameters.keys
    if (index := index_key(known)) in keys:
        drift = region.medium.index_per_kelvin(calibration.wavelength_nm) * uncertainty.drift_k
        covariance[keys.index(index), keys.index(index)] += drift**2
    scatter = require_joint(calibration).scatter_px
    noise = next((scatter[kind] for kind in (STRIPE, STEP, *SCANNED) if kind in scatter), 0.0)
    return CalibrationInUse(calibration, region, known, covariance, uncertainty, noise)


def index_key(known: StoredEstimate) -> MediumIndex | None:
    """Return the parameter key of the index of the camera's medium; None in air."""
    return None if known.view.medium is None else known.parameters.index_key(known.view.medium)


def length_uncertainties(use: CalibrationInUse) -> list[LengthUncertainty]:
    """Return the uncertainty of every length that fits into the volume, along X, Y and Z."""
    found = []
    for axis in "YZ":
        for length in LENGTHS_MM:
            ends = find_ends(use.region, axis, length)
            if len(ends):
                std = [
                    compute_volume_lengths(use, ends).std_mm(use.covariance, noise_px=noise)
                    for noise in (0.0, use.noise_px)
                ]
                found.append(LengthUncertainty(axis, length, *(2 * float(each.max()) for each in std)))
    # Along the stage's motion, the same point of the sheet measures both ends, so only the stage contributes.
    position, scale = np.sqrt(2.0) * use.uncertainty.stage_position_mm, use.uncertainty.stage_scale
    along_x = {length: 2 * float(np.hypot(position, scale * length)) for length in sorted({e.length_mm for e in found})}
    return [LengthUncertainty("X", length, stage, stage) for length, stage in along_x.items()] + found


def compute_volume_lengths(use: CalibrationInUse, ends: np.ndarray) -> Lengths:
    """Return lengths between points given by Y and Z (M, 2, 2)."""
    points = sample_sheet(use.known, ends.reshape(-1, 2))
    first = 2 * np.arange(len(ends))
    return compute_lengths(points, first, first + 1)


def find_ends(region: SheetRegion, axis: str, length_mm: float) -> np.ndarray:
    """Return end points (M, 2, 2) of lengths along an axis throughout a region; empty if the length does not fit."""
    depths = region.mesh(_PLACES, 2)[:, 0, 1]
    found = []
    if axis == "Y":
        for depth in depths:
            low, high = region.width_at(depth)
            starts = np.linspace(low, high - length_mm, _PLACES) if high - low >= length_mm else ()
            found += [((y, depth), (y + length_mm, depth)) for y in starts]
    elif np.ptp(depths) >= length_mm:
        for depth in np.linspace(depths[0], depths[-1] - length_mm, _PLACES):
            low, high = zip(region.width_at(depth), region.width_at(depth + length_mm), strict=True)
            starts = np.linspace(max(low), min(high), _PLACES) if max(low) < min(high) else ()
            found += [((y, depth), (y, depth + length_mm)) for y in starts]
    return np.array(found).reshape(-1, 2, 2)


def uncertainty_maps(use: CalibrationInUse) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return Y and Z (R, C, 2) of a mesh of the sheet, and maps of standard uncertainties (R, C) in mm by title.

    For points, they are uncertainties of the coordinates without rigid motion of the whole volume: from the calibration
    alone, and with stripe noise. For a short length about each point, they are from the calibration; its centre is
    moved inwards if the length would exceed the volume.
    """
    mesh = use.region.mesh(_ROWS, _COLUMNS)
    at = mesh.reshape(-1, 2)
    points = sample_sheet(use.known, at)
    root = CovarianceRoot.from_covariance(use.covariance).root
    moved = remove_rigid_motion(at, (points.by_parameters @ root).transpose(2, 0, 1))
    calibration = np.sqrt(np.sum(moved**2, axis=0))
    shown = {"calibration": calibration, "single point": np.hypot(calibration, points.by_px * use.noise_px)}
    maps = {
        f"u({axis}), {name}": values[:, "XYZ".index(axis)].reshape(mesh.shape[:2])
        for name, values in shown.items()
        for axis in "YZX"
    }
    longest = _SHORT_SHARE * float(np.ptp(use.region.outline_mm, axis=0).min())
    power = 10.0 ** np.floor(np.log10(longest))
    short = float(max(step * power for step in (1, 2, 5) if step * power <= longest))
    for axis, length in (("Y", (short, 0.0)), ("Z", (0.0, short))):
        maps[f"u of {short:g} mm along {axis}"] = _map_length(use, mesh, np.array(length))
    return mesh, maps


def remove_rigid_motion(at_mm: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return displacements (R, N, 3) of points at Y and Z (N, 2) after subtracting the best-fit rigid motions."""
    points = np.column_stack([np.zeros(len(at_mm)), at_mm - at_mm.mean(axis=0)])
    turns = np.cross(np.eye(3)[:, None], points[None])
    shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
    basis, _ = np.linalg.qr(np.concatenate([shifts, turns]).reshape(6, -1).T)
    flat = moved.reshape(len(moved), -1)
    return (flat - (flat @ basis) @ basis.T).reshape(moved.shape)


def _map_length(use: CalibrationInUse, mesh: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return the standard uncertainty (R, C) of a length vector (2,) centred at, or near, each mesh point."""
    middle = mesh.reshape(-1, 2).copy()
    low, high = use.region.outline_mm[:, 1].min(), use.region.outline_mm[:, 1].max()
    half = length / 2
    middle[:, 1] = np.clip(middle[:, 1], low + half[1], high - half[1])
    for at in middle:
        ranges = [use.region.width_at(z) for z in {at[1] - half[1], at[1] + half[1]}]
        left, right = max(a for a, _ in ranges) + half[0], min(b for _, b in ranges) - half[0]
        at[0] = np.clip(at[0], left, right) if left < right else (left + right) / 2
    ends = np.stack([middle - half, middle + half], axis=1)
    return compute_volume_lengths(use, ends).std_mm(use.covariance).reshape(mesh.shape[:2])


@dataclass(frozen=True, eq=False)
class Change:
    """Displacement in mm of points of the same pixels between two calibrations.

    ``moved_mm`` (R, C, 3) is the displacement in X, Y and Z of the OCS at Y and Z ``at_mm`` (R, C, 2). A rigid motion
    of all points is subtracted; ``largest_mm`` is the largest distance before that.
    """

    at_mm: np.ndarray
    moved_mm: np.ndarray
    largest_mm: float


def require_same_sensor(calibration: Calibration, other: Calibration) -> None:
    """Check that two calibrations can be of the same sensor; CalibrationError if not."""
    sizes = [f"{c.camera.width_px} x {c.camera.height_px} px" for c in (calibration, other)]
    for name, (one, two) in {
        "image size": sizes,
        "stripe_along": (calibration.stripe_along, other.stripe_along),
    }.items():
        if one != two:
            raise CalibrationError(
                f"the calibrations are of different sensors: {name} is {one} in one and {two} in the other"
            )


def compare_calibrations(calibration: Calibration, other: Calibration, region: SheetRegion) -> Change:
    """Return the displacements between a calibration and another one, in its region.

    CalibrationError if the other calibration is of another sensor, or does not see the sheet in part of the region.
    """
    require_same_sensor(calibration, other)
    mesh = region.mesh(_ROWS, _COLUMNS)
    pixels = project_sheet_points(read_region_estimate(calibration, region), mesh.reshape(-1, 2))
    points = []
    for each in (calibration, other):
        through = each if region.view.window else each.model_copy(update={"window": None})
        found = points_on_sheet(through, pixels, medium_index=each.medium_index(region.medium)).points_mm
        if not np.isfinite(found).all():
            raise CalibrationError(
                "one of the calibrations does not see the sheet in part of the volume: they cannot be compared"
            )
        points.append(found)
    moved = (points[0] - points[1]) @ calibration.object_transform()[:3, :3]
    form = remove_rigid_motion(mesh.reshape(-1, 2), moved[None])[0]
    return Change(mesh, form.reshape(*mesh.shape[:2], 3), float(np.linalg.norm(moved, axis=1).max()))
