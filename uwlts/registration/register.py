"""Registration of several scans into one frame by joint least squares over all overlaps.

Residuals are the distances of patches of one scan from the surface of another (`uwlts.fitting.patches`), and the
differences of common sphere centres. The unknowns are the pose of each scan except the first, and the amplitudes of
the systematic patterns of each scan (`PointUncertainty`). The prior of an amplitude has unit variance. Scans of one
calibration share amplitudes. Tukey's biweight rejects outliers. Undetermined directions are reported.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from uwlts.argument_types import check_arguments
from uwlts.errors import EvaluationError
from uwlts.files.reading import log_warnings
from uwlts.fitting.patches import surface_patches
from uwlts.model.sensor import Table, is_rigid
from uwlts.model.short_text import Brief
from uwlts.registration.coarse_registration import estimate_coarse_poses
from uwlts.registration.joint_registration import (
    FEWEST_OF_PAIR,
    ROUNDS,
    JointRegistration,
    PairEvidence,
    PoseSolution,
    approach,
    settle,
)
from uwlts.registration.marker_spheres import find_markers
from uwlts.registration.merging import merge_clouds
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import load_cloud
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import PoseFormat, read_poses, write_poses
from uwlts.storage.repeated_points import find_repeated

_SMALLEST = 1e-6
"""Smallest length in mm or angle in deg that is accepted, and the reciprocal of the largest: others are slips."""
_REACH = 0.05  # default distance between overlapping surfaces at the initial poses, relative to the scan's size
_ROUNDED = 1e-6  # largest error of a rotation matrix element that rounding in a file may cause
_PART = 0.1  # least component of a scan in an undetermined direction, relative to the largest, that is reported
_NO_TURN = 0.05
"""Smallest fraction of a motion's rms shift by rotation; below it, the motion counts as a pure translation."""


@dataclass(frozen=True)
class PairFit:
    """Agreement of two scans after registration.

    Attributes
    ----------
    scans : (int, int)
        Numbers of the scans.
    patches : int
        Number of patches of the overlap with a positive weight.
    mean_mm, rms_mm : float
        Mean and root mean square of their distances.
    scatter : float
        Ratio of the robust standard deviation of the distances to their stated noise.
    closure_mm : float or None
        Root-mean-square distance here, with noise subtracted, if all other pairs alone determine the poses; None if
        they do not.
    spheres : int
        Number of common spheres.
    sphere_rms : float or None
        Root-mean-square difference of their centres divided by its standard uncertainty.
    """

    scans: tuple[int, int]
    patches: int
    mean_mm: float
    rms_mm: float
    scatter: float
    closure_mm: float | None
    spheres: int
    sphere_rms: float | None


@dataclass(frozen=True, eq=False)
class Overlap:
    """Positions (Q, 3) in the common frame where two scans overlap, and the distances (Q,) there, in mm."""

    places_mm: np.ndarray
    distance_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class OpenMovement:
    """An undetermined motion of a scan: a translation along a unit direction, or a rotation about an axis.

    ``point_mm`` is None for a translation. For a rotation, it is the point of the axis nearest to the scan's centroid.
    """

    scan: int
    direction: np.ndarray
    point_mm: np.ndarray | None

    def describe(self) -> str:
        """Describe the motion in the common frame as text."""
        # Adding zero removes the sign of a rounded -0.
        along = "({:.3f}, {:.3f}, {:.3f})".format(*(np.round(self.direction, 3) + 0.0))
        if self.point_mm is None:
            return f"shift along {along}"
        point = "({:.1f}, {:.1f}, {:.1f})".format(*(np.round(self.point_mm, 1) + 0.0))
        return f"turn about the line through {point} mm along {along}"


@dataclass(frozen=True, eq=False, repr=False)
class RegisteredScans(Brief):
    """Several scans in the frame of the first.

    Attributes
    ----------
    names : tuple of str
    poses : (N, 4, 4) float64
        Transform from the frame of each scan to that of the first, mm.
    covariance : (6 N, 6 N) float64
        Covariance of the translation (mm), then the rotation (rad), of each scan about `middles_mm`. It is 0 for the
        first scan, and in undetermined directions unless the initial poses have a standard uncertainty.
    middles_mm : (N, 3) float64
        Centroids of the scans in the common frame.
    open_movements : tuple of OpenMovement
        Motions that neither surfaces nor spheres determine. They keep their initial values.
    pairs : tuple of PairFit
    overlaps : tuple of Overlap
        Overlap of each pair, in the order of ``pairs``.
    narrow_overlaps : tuple of (int, int, int)
        Numbers of two scans and of the patches in their overlap, where these are too few to be used.
    scale : float
        Root mean square of the estimated pattern amplitudes (expected: 1); NaN without patterns.
    cloud : PointCloud
        All points with their uncertainty, including that of the registration. Image numbers continue from scan to scan.
    """

    names: tuple[str, ...]
    poses: np.ndarray
    covariance: np.ndarray
    middles_mm: np.ndarray
    open_movements: tuple[OpenMovement, ...]
    pairs: tuple[PairFit, ...]
    overlaps: tuple[Overlap, ...] = field(repr=False)
    narrow_overlaps: tuple[tuple[int, int, int], ...]
    scale: float
    cloud: PointCloud

    @property
    def std(self) -> np.ndarray:
        """Standard uncertainty (N, 6) of each scan's translation (mm) and rotation (rad)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 6)

    def record(self) -> Table:
        """Return everything except points and distances as JSON; angles in rad."""
        return {
            "scans": [
                {"name": name, "transform": pose.tolist(), "middle_mm": middle.tolist()}
                for name, pose, middle in zip(self.names, self.poses, self.middles_mm, strict=True)
            ],
            "covariance": self.covariance.tolist(),
            "open_movements": [
                {"scan": self.names[each.scan], "movement": each.describe()} for each in self.open_movements
            ],
            "pairs": [{**asdict(pair), "scans": [self.names[number] for number in pair.scans]} for pair in self.pairs],
            "narrow_overlaps": [
                {"scans": [self.names[first], self.names[second]], "patches": patches}
                for first, second, patches in self.narrow_overlaps
            ],
            "pattern_scale": self.scale if np.isfinite(self.scale) else None,
            "points": len(self.cloud),
        }

    @check_arguments
    def save_poses(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the poses of the scans as CSV in the format "matrix", mm; OutputError if writing fails."""
        write_poses(path, self.poses, overwrite=overwrite)

    def lines(self) -> list[str]:
        """Return a summary as text."""
        lines = [f"{len(self.names)} scans, {len(self.cloud)} points, {len(self.pairs)} overlaps"]
        for pair in self.pairs:
            first, second = (self.names[number] for number in pair.scans)
            closure = "" if pair.closure_mm is None else f", closure {pair.closure_mm:.4f}"
            spheres = (
                "" if not pair.spheres else f"; {pair.spheres} spheres, rms {pair.sphere_rms:.2f} of their uncertainty"
            )
            lines.append(
                f"  {first} - {second}: {pair.patches} patches, mm: mean {pair.mean_mm:+.4f}, rms {pair.rms_mm:.4f}"
                f"{closure}{spheres}"
            )
        lines += [
            f"  {self.names[first]} - {self.names[second]}: left out, "
            f"{patches} patches overlap, fewer than {FEWEST_OF_PAIR}"
            for first, second, patches in self.narrow_overlaps
        ]
        for name, std in list(zip(self.names, self.std, strict=True))[1:]:
            shift, turn = np.linalg.norm(std[:3]), np.degrees(np.linalg.norm(std[3:]))
            lines.append(f"  {name}: standard uncertainty {shift:.4f} mm, {turn:.5f} deg")
        lines += [
            f"  undetermined, initial value kept: {self.names[each.scan]}: {each.describe()}"
            for each in self.open_movements
        ]
        return lines


def register(
    clouds: Sequence[PointCloud | str | os.PathLike[str]],
    *,
    poses: np.ndarray | str | os.PathLike[str] | None = None,
    pose_format: PoseFormat = "matrix",
    pose_unit: Unit | None = None,
    start_std_mm: float | None = None,
    start_std_deg: float | None = None,
    search: bool = False,
    sphere_mm: float | None = None,
    reach_mm: float | None = None,
    unit: Unit | None = None,
    progress: ProgressListener = ignore_progress,
) -> RegisteredScans:
    """Register overlapping scans in the frame of the first, and merge them into one cloud with uncertainty.

    Parameters
    ----------
    clouds
        Two or more clouds or their files, in any order. Each must overlap another one, not necessarily the first.
    poses : (N, 4, 4) or path, optional
        Initial pose of each scan in the common frame, in the order of the clouds: an array or a CSV file. By default
        all scans have one frame.
    pose_format, pose_unit
        As for `reconstruct`.
    start_std_mm : float, optional
        Standard uncertainty of each scan's initial position along each axis. The initial poses then enter the estimate
        as observations, and determine motions that the surfaces do not.
    start_std_deg : float, optional
        Standard uncertainty of each scan's initial rotation about its centroid.
    search : bool
        Search for the initial poses by surface features (KISS-Matcher) or spheres. Given poses are ignored.
    sphere_mm : float, optional
        Diameter of spheres in the scene. Their centres connect scans without a common surface.
    reach_mm : float, optional
        Largest distance between overlapping surfaces at the initial poses; by default a twentieth of a scan's size.
    unit : {"mm", "m"}, optional
        As for `export`.
    progress : callable, optional
        Called with the number of steps done and the total number.

    Returns
    -------
    RegisteredScans
        Poses of the scans with their joint covariance, and the merged cloud.

    Raises
    ------
    CaptureError
        A file cannot be read.
    EvaluationError
        Scans have too few points or no overlap, or no initial poses were found.
    SetupError
        The search needs a library that is not installed.

    Examples
    --------
    >>> found = uwlts.register(["top.cloud.h5", "left.cloud.h5", "right.cloud.h5"])
    >>> found.cloud.save("pipe.cloud.h5")
    """
    names = tuple(
        f"scan {number}" if isinstance(each, PointCloud) else Path(each).stem for number, each in enumerate(clouds, 1)
    )
    scans = [load_cloud(each, unit=unit) for each in clouds]
    if isinstance(poses, str | os.PathLike):
        poses = read_poses(Path(poses), pose_format=pose_format, unit=pose_unit)[0]
    if len(scans) < 2:
        raise EvaluationError(f"found {len(scans)} cloud; a registration needs two or more")
    given = {"sphere_mm": sphere_mm, "reach_mm": reach_mm, "start_std_mm": start_std_mm, "start_std_deg": start_std_deg}
    for name, size in given.items():
        if size is not None and not _SMALLEST <= size <= 1 / _SMALLEST:
            raise EvaluationError(f"`{name}` is {size:g}; expected {_SMALLEST:g} to {1 / _SMALLEST:g}")
    if (start_std_mm is None) != (start_std_deg is None):
        raise EvaluationError("the uncertainty of the initial poses needs both start_std_mm and start_std_deg")
    scans = _omit_shared_points(scans, names)
    steps = len(scans) + ROUNDS
    patches = []
    for number, (name, scan) in enumerate(zip(names, scans, strict=True)):
        try:
            patches.append(surface_patches(scan.points_mm, scan.uncertainty, frame=scan.frame))
        except EvaluationError as error:
            raise EvaluationError(f"{name}: {error}") from error
        progress(number + 1, steps)
    markers = [find_markers(scan, sphere_mm) if sphere_mm else [] for scan in scans]
    start = (
        estimate_coarse_poses([scan.points_mm for scan in scans], patches, markers, names, sphere_mm=sphere_mm)
        if search
        else _check_poses(poses, len(scans))
    )
    std = None if start_std_mm is None or start_std_deg is None else (start_std_mm, float(np.radians(start_std_deg)))
    shared = [{} if scan.uncertainty is None else scan.uncertainty.shared for scan in scans]
    joint = JointRegistration(patches, markers, start, start_std=std, sphere_mm=sphere_mm, shared=shared)
    sizes = [np.linalg.norm(np.ptp(scan.points_mm, axis=0)) for scan in scans]
    reach = 0.0 if search else reach_mm or _REACH * float(np.median(sizes))
    reach = approach(joint, reach, names, lambda done: progress(len(scans) + done, steps))
    progress(steps, steps)
    distances, pairs, solution, known = settle(joint, reach, names)
    amounts = np.concatenate(joint.patterns)
    covariance = np.zeros((6 * len(scans),) * 2)
    covariance[6:, 6:] = known[: joint.unknown_poses, : joint.unknown_poses]
    return RegisteredScans(
        names=names,
        poses=joint.poses,
        covariance=covariance,
        middles_mm=joint.middles_mm,
        open_movements=_open_movements(solution.open_directions, joint.middles_mm, joint.sizes),
        pairs=tuple(_summarise_pair(joint, key, pairs, solution) for key in pairs),
        overlaps=tuple(_measure_overlap(pair) for pair in pairs.values()),
        narrow_overlaps=joint.find_narrow_overlaps(distances),
        scale=float(np.sqrt(np.mean(amounts**2))) if len(amounts) else np.nan,
        cloud=merge_clouds(scans, names, joint, known),
    )


def _omit_shared_points(scans: Sequence[PointCloud], names: Sequence[str]) -> list[PointCloud]:
    """Return the scans without points that an earlier one contains, with a warning; EvaluationError if none is left."""
    shared = find_repeated(np.vstack([scan.points_mm for scan in scans]))
    result, ends = [], np.cumsum([len(scan) for scan in scans])
    for repeated, scan, name in zip(np.split(shared, ends[:-1]), scans, names, strict=True):
        if repeated.all():
            raise EvaluationError(
                f"all points of {name} are those of another scan. A copy is no evidence: leave it out"
            )
        if count := np.count_nonzero(repeated):
            warning = (
                f"{count} of {len(scan)} points are those of another scan and are omitted: they are no new evidence"
            )
            log_warnings(name, [warning])
            scan = replace(scan.select(~repeated), warnings=[*scan.warnings, warning])
        result.append(scan)
    return result


def _summarise_pair(
    joint: JointRegistration, key: tuple[int, int], pairs: dict[tuple[int, int], PairEvidence], solution: PoseSolution
) -> PairFit:
    pair = pairs[key]
    counted = pair.residuals[pair.counted]
    centres = pair.residuals[pair.patches :]
    return PairFit(
        scans=key,
        patches=len(counted),
        mean_mm=float(np.mean(counted)) if len(counted) else 0.0,
        rms_mm=float(np.sqrt(np.mean(counted**2))) if len(counted) else 0.0,
        scatter=pair.spread,
        closure_mm=_compute_closure_rms(joint, key, pairs, solution) if len(counted) else None,
        spheres=pair.spheres,
        # Sphere residuals are whitened, so that they are relative to their uncertainty.
        sphere_rms=float(np.sqrt(np.mean(centres**2))) if pair.spheres else None,
    )


def _measure_overlap(pair: PairEvidence) -> Overlap:
    counted = pair.counted[: pair.patches]
    return Overlap(pair.places_mm[counted], pair.residuals[: pair.patches][counted])


def _open_movements(directions: np.ndarray, middles_mm: np.ndarray, sizes_mm: np.ndarray) -> tuple[OpenMovement, ...]:
    """Convert undetermined directions (K, 6 (N - 1)) into motions of N scans, the first fixed: translations first."""
    found = []
    for number in range(1, len(middles_mm)):
        twists = directions[:, 6 * (number - 1) : 6 * number] * np.repeat([1.0, sizes_mm[number]], 3)
        if not len(twists):
            continue
        _, strengths, rows = np.linalg.svd(twists, full_matrices=False)
        basis = rows[strengths > _PART]
        if not len(basis):
            continue
        # Combinations in ascending order of their rotation, so that pure translations come first.
        left, turns, _ = np.linalg.svd(basis[:, 3:], full_matrices=True)
        turns = np.append(turns, np.zeros(len(basis) - len(turns)))
        for coefficients, turn in zip(left.T[::-1], turns[::-1], strict=True):
            shift, turned = (coefficients @ basis).reshape(2, 3)
            turned = turned / sizes_mm[number]
            if turn < _NO_TURN:
                found.append(OpenMovement(number, _orient(shift), None))
            else:
                nearest = middles_mm[number] + np.cross(turned, shift) / (turned @ turned)
                found.append(OpenMovement(number, _orient(turned), nearest))
    return tuple(found)


def _orient(direction: np.ndarray) -> np.ndarray:
    """Normalise a direction so that its largest component is positive."""
    unit = direction / np.linalg.norm(direction)
    return unit * np.sign(unit[np.argmax(np.abs(unit))])


def _compute_closure_rms(
    joint: JointRegistration, key: tuple[int, int], pairs: dict[tuple[int, int], PairEvidence], solution: PoseSolution
) -> float | None:
    """Return the rms distance that remains in an overlap if all other pairs determine the poses.

    Return None if they do not determine them.
    """
    others = [pair for other, pair in pairs.items() if other != key]
    if not others:
        return None
    without = joint.solve(others)
    if len(without.open_directions) > len(solution.open_directions):
        return None
    pair = pairs[key]
    left = (pair.residuals + pair.derivatives @ without.step)[pair.counted]
    noise = (pair.std * pair.spread)[pair.counted]
    return float(np.sqrt(max(np.mean(left**2) - np.mean(noise**2), 0.0)))


def _check_poses(poses: np.ndarray | None, count: int) -> np.ndarray:
    if poses is None:
        return np.tile(np.eye(4), (count, 1, 1))
    start = np.array(poses, dtype=np.float64)
    if start.shape != (count, 4, 4):
        raise EvaluationError(f"the initial poses have the shape {start.shape}; expected ({count}, 4, 4)")
    if not is_rigid(start, within=_ROUNDED):
        raise EvaluationError("an initial pose is not a rigid transform; expected a rotation and a last row of 0 0 0 1")
    return np.linalg.inv(start[0]) @ start
