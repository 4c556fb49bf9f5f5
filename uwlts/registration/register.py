"""Registration of several scans into one frame: joint least squares over all overlaps, with what stays open named.

Residuals are distances of patches of one scan from the surface of another (`uwlts.fitting.patches`), and differences
of the centres of spheres that several scans show. Unknown are the pose of every scan but the first, and how much of
each of its systematic patterns a scan has (`PointUncertainty`), which are known beforehand to be of standard deviation
one, and the same in all scans as far as they come from one calibration. Tukey's biweight leaves out what fits no
surface.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.patches import surface_patches
from uwlts.model.brief import Brief
from uwlts.model.calibration import is_rigid
from uwlts.model.sensor import Table
from uwlts.registration.coarse_registration import coarse_poses
from uwlts.registration.joint_registration import FEWEST_OF_PAIR, NARROWER, JointRegistration, PairEvidence, Solved
from uwlts.registration.marker_spheres import find_markers
from uwlts.registration.merging import merged_cloud
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import loaded_cloud
from uwlts.storage.pose_files import PoseFormat, Unit, read_poses, write_poses

_ROUNDS = 60
_STILL_MM = 1e-5
"""A step that moves the usual point by less changes nothing that can be measured."""
_REACH = 0.05
"""Of a scan's size: how far overlapping surfaces lie apart at the start, at most, unless that is given."""
_ROUNDED = 1e-6
"""Largest error of a rotation's elements that is rounding of a file."""
_PART = 0.1
"""Part of a scan in an open direction, relative to the largest, below which it does not move in it."""
_NO_TURN = 0.05
"""Shift of the usual point by the turn of a movement, relative to the movement, below which it is a shift alone."""


@dataclass(frozen=True)
class PairFit:
    """How two scans fit: numbers of the scans, patches of the overlap that count, and distances, mm.

    ``mean_mm`` and ``rms_mm`` are of the distances after registration, ``scatter`` is their robust standard deviation
    in units of that which noise explains. ``closure_mm`` is the root mean square distance, with noise taken off, that
    the other overlaps alone leave here; None where without this pair the scans are not connected. ``spheres`` is the
    number of common spheres, ``sphere_rms`` the root mean square difference of their centres over its uncertainty.
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
    """Places (Q, 3) where two scans show one surface, common frame, and their distances (Q,), mm."""

    places_mm: np.ndarray
    distance_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class OpenMovement:
    """A movement of a scan that is open: a shift along a unit direction, or a turn about a line through a point.

    ``point_mm`` is None for a shift; for a turn it is the point of the line that lies nearest to the scan's middle.
    """

    scan: int
    direction: np.ndarray
    point_mm: np.ndarray | None

    def words(self) -> str:
        """The movement in words, in the common frame."""
        along = "({:.3f}, {:.3f}, {:.3f})".format(*(self.direction + 0.0))
        if self.point_mm is None:
            return f"shift along {along}"
        return "turn about the line through ({:.1f}, {:.1f}, {:.1f}) mm along ".format(*self.point_mm) + along


@dataclass(frozen=True, eq=False, repr=False)
class RegisteredScans(Brief):
    """Several scans in the frame of the first.

    Attributes
    ----------
    names : tuple of str
    poses : (N, 4, 4) float64
        Frame of the first scan from that of each, mm.
    covariance : (6 N, 6 N) float64
        Of a shift (mm), then a turn (rad) of each scan about its `middles_mm`; 0 for the first scan, and in directions
        that are open unless the start was given with its standard uncertainty.
    middles_mm : (N, 3) float64
    open_movements : tuple of OpenMovement
        What neither surfaces nor spheres tell; left as at the start.
    pairs : tuple of PairFit
    overlaps : tuple of Overlap
        Where each pair overlaps, in the order of the pairs.
    narrow_overlaps : tuple of (int, int, int)
        Numbers of two scans, and of the patches of their overlap: too few to count.
    scale : float
        Patterns that were found, root mean square over all in units of what the calibration expects; NaN without.
    cloud : PointCloud
        All points with their uncertainty, that of the registration included. Numbers of images go on from scan to scan.
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
        """Standard uncertainty (N, 6) of each scan's shift (mm) and turn (rad)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 6)

    def record(self) -> Table:
        """All but points and distances as JSON; angles in rad."""
        return {
            "scans": [
                {"name": name, "transform": pose.tolist(), "middle_mm": middle.tolist()}
                for name, pose, middle in zip(self.names, self.poses, self.middles_mm, strict=True)
            ],
            "covariance": self.covariance.tolist(),
            "open_movements": [
                {"scan": self.names[each.scan], "movement": each.words()} for each in self.open_movements
            ],
            "pairs": [
                {
                    "scans": [self.names[number] for number in pair.scans],
                    "patches": pair.patches,
                    "mean_mm": pair.mean_mm,
                    "rms_mm": pair.rms_mm,
                    "scatter": pair.scatter,
                    "closure_mm": pair.closure_mm,
                    "spheres": pair.spheres,
                    "sphere_rms": pair.sphere_rms,
                }
                for pair in self.pairs
            ],
            "narrow_overlaps": [
                {"scans": [self.names[first], self.names[second]], "patches": patches}
                for first, second, patches in self.narrow_overlaps
            ],
            "pattern_scale": self.scale if np.isfinite(self.scale) else None,
            "points": len(self.cloud),
        }

    def save_poses(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the poses of the scans as CSV of the format matrix, mm; OutputError if that fails."""
        write_poses(path, self.poses, overwrite=overwrite)

    def lines(self) -> list[str]:
        """The summary as text."""
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
            f"  open, left as at the start: {self.names[each.scan]}: {each.words()}" for each in self.open_movements
        ]
        return lines


def register(
    clouds: Sequence[PointCloud | str | os.PathLike[str]],
    *,
    poses: np.ndarray | str | os.PathLike[str] | None = None,
    pose_format: PoseFormat = "matrix",
    pose_unit: Unit = "mm",
    start_std_mm: float | None = None,
    start_std_deg: float | None = None,
    search: bool = False,
    sphere_mm: float | None = None,
    reach_mm: float | None = None,
    progress: ProgressListener = unheard,
) -> RegisteredScans:
    """Bring scans that overlap into the frame of the first, and merge them into one cloud with its uncertainty.

    Parameters
    ----------
    clouds
        Two or more clouds or their files, in any order; every one overlaps another, not necessarily the first.
    poses : (N, 4, 4) or path, optional
        Pose of every scan at the start, in the order of the clouds, common frame from each scan's: an array, or a CSV
        file. The scans' frames are taken as one unless given.
    pose_format, pose_unit
        As for `reconstruct`.
    start_std_mm : float, optional
        Standard uncertainty of each scan's shift at the start along each axis. The start counts as evidence then, and
        decides what surfaces leave open.
    start_std_deg : float, optional
        The same of its turn about its middle.
    search : bool
        Search the start by the shape of the surfaces (KISS-Matcher), or by spheres, whatever the frames and poses are.
    sphere_mm : float, optional
        Diameter of spheres that stand in the scene: their centres tie scans together that do not see one surface.
    reach_mm : float, optional
        How far overlapping surfaces lie apart at the start, at most; a twentieth of a scan's size unless given.
    progress : callable, optional
        Called with steps done and steps in all.

    Raises
    ------
    CaptureError
        A file cannot be read.
    EvaluationError
        Scans have too few points or no overlap, or no start was found.
    SetupError
        The library for the search is not installed.

    Examples
    --------
    >>> found = uwlts.register(["top.ply", "left.ply", "right.ply"])
    >>> found.cloud.save("pipe.ply")
    """
    names = tuple(_name(each, number) for number, each in enumerate(clouds))
    scans = [_opened(each) for each in clouds]
    if isinstance(poses, str | os.PathLike):
        poses = read_poses(Path(poses), pose_format=pose_format, unit=pose_unit)[0]
    if len(scans) < 2:
        raise EvaluationError(f"found {len(scans)} cloud; two or more are needed for a registration")
    for name, length in (("sphere_mm", sphere_mm), ("reach_mm", reach_mm), ("start_std_mm", start_std_mm)):
        if length is not None and not 0 < length < np.inf:
            raise EvaluationError(f"{name} is {length:g}; expected a positive length in mm")
    if (start_std_mm is None) != (start_std_deg is None):
        raise EvaluationError("the start's uncertainty needs both parts: start_std_mm and start_std_deg")
    steps = len(scans) + _ROUNDS
    patches = []
    for number, (name, scan) in enumerate(zip(names, scans, strict=True)):
        try:
            patches.append(surface_patches(scan.points_mm, scan.uncertainty, frame=scan.frame))
        except EvaluationError as error:
            raise EvaluationError(f"{name}: {error}") from error
        progress(number + 1, steps)
    markers = [find_markers(scan, sphere_mm) if sphere_mm else [] for scan in scans]
    start = (
        coarse_poses([scan.points_mm for scan in scans], patches, markers, names, sphere_mm=sphere_mm)
        if search
        else _given(poses, len(scans))
    )
    std = None if start_std_mm is None or start_std_deg is None else (start_std_mm, float(np.radians(start_std_deg)))
    shared = [{} if scan.uncertainty is None else scan.uncertainty.shared for scan in scans]
    joint = JointRegistration(patches, markers, start, start_std=std, sphere_mm=sphere_mm, shared=shared)
    least = 2 * max(each.radius_mm for each in patches)
    reach = least if search else reach_mm or _REACH * float(np.median([_size(scan) for scan in scans]))
    for done in range(_ROUNDS):
        pairs = joint.evidence(joint.distances(reach))
        joint.require_connected(list(pairs), names)
        step = joint.solved(list(pairs.values())).step
        joint.move(step)
        progress(len(scans) + done + 1, steps)
        if (
            reach <= least
            and np.abs(step[: joint.unknown_poses] / joint.units[: joint.unknown_poses]).max() < _STILL_MM
        ):
            break
        reach = max(NARROWER * reach, least)
    progress(steps, steps)
    distances = joint.distances(reach)
    pairs = joint.evidence(distances)
    solved = joint.solved(list(pairs.values()))
    _require_settled(solved, joint.unknown_poses)
    amounts = np.concatenate(joint.patterns)
    covariance = np.zeros((6 * len(scans),) * 2)
    covariance[6:, 6:] = solved.covariance[: joint.unknown_poses, : joint.unknown_poses]
    return RegisteredScans(
        names=names,
        poses=joint.poses,
        covariance=covariance,
        middles_mm=joint.middles_mm,
        open_movements=_open_movements(solved.open_directions, joint.middles_mm, joint.sizes),
        pairs=tuple(_fit_of(joint, key, pairs, solved) for key in pairs),
        overlaps=tuple(_overlap(pair) for pair in pairs.values()),
        narrow_overlaps=joint.narrow_overlaps(distances),
        scale=float(np.sqrt(np.mean(amounts**2))) if len(amounts) else np.nan,
        cloud=merged_cloud(scans, names, joint, solved.covariance),
    )


def _require_settled(solved: Solved, unknown: int) -> None:
    """EvaluationError where a further step would move the poses by more than their uncertainty."""
    std = np.sqrt(np.diag(solved.covariance)[:unknown])
    moves = float(np.max(np.abs(solved.step[:unknown]) / np.where(std > 0, std, np.inf), initial=0.0))
    if moves > 1:
        raise EvaluationError(
            f"the registration does not settle: after {_ROUNDS} rounds the next one would move a scan by {moves:.2g} "
            "standard uncertainties. Give poses nearer to the true ones, or scans that overlap more"
        )


def _fit_of(
    joint: JointRegistration, key: tuple[int, int], pairs: dict[tuple[int, int], PairEvidence], solved: Solved
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
        closure_mm=_closure(joint, key, pairs, solved) if len(counted) else None,
        spheres=pair.spheres,
        # Relative to the centres' uncertainty in the estimate.
        sphere_rms=float(np.sqrt(np.mean(centres**2))) if pair.spheres else None,
    )


def _overlap(pair: PairEvidence) -> Overlap:
    counted = pair.counted[: pair.patches]
    return Overlap(pair.places_mm[counted], pair.residuals[: pair.patches][counted])


def _open_movements(directions: np.ndarray, middles_mm: np.ndarray, sizes_mm: np.ndarray) -> tuple[OpenMovement, ...]:
    """Movements of N scans, the first fixed, from open directions (K, 6 (N - 1)): shifts, then turns about middles."""
    found = []
    for number in range(1, len(middles_mm)):
        twists = directions[:, 6 * (number - 1) : 6 * number] * np.repeat([1.0, sizes_mm[number]], 3)
        if not len(twists):
            continue
        _, strengths, rows = np.linalg.svd(twists, full_matrices=False)
        basis = rows[strengths > _PART]
        if not len(basis):
            continue
        # Combinations without a turn first, each as a row of coefficients.
        left, turns, _ = np.linalg.svd(basis[:, 3:], full_matrices=True)
        turns = np.append(turns, np.zeros(len(basis) - len(turns)))
        for coefficients, turn in zip(left.T[::-1], turns[::-1], strict=True):
            shift, turned = (coefficients @ basis).reshape(2, 3)
            turned = turned / sizes_mm[number]
            if turn < _NO_TURN:
                found.append(OpenMovement(number, _pointing(shift), None))
            else:
                nearest = middles_mm[number] + np.cross(turned, shift) / (turned @ turned)
                found.append(OpenMovement(number, _pointing(turned), nearest))
    return tuple(found)


def _pointing(direction: np.ndarray) -> np.ndarray:
    """The unit vector along a direction whose largest part is positive."""
    unit = direction / np.linalg.norm(direction)
    return unit * np.sign(unit[np.argmax(np.abs(unit))])


def _closure(
    joint: JointRegistration, key: tuple[int, int], pairs: dict[tuple[int, int], PairEvidence], solved: Solved
) -> float | None:
    """Distance that the other pairs alone leave in an overlap; None where they do not tell it."""
    others = [pair for other, pair in pairs.items() if other != key]
    if not others:
        return None
    without = joint.solved(others)
    if len(without.open_directions) > len(solved.open_directions):
        return None
    pair = pairs[key]
    left = (pair.residuals + pair.derivatives @ without.step)[pair.counted]
    noise = (pair.std * pair.spread)[pair.counted]
    return float(np.sqrt(max(np.mean(left**2) - np.mean(noise**2), 0.0)))


def _given(poses: np.ndarray | None, count: int) -> np.ndarray:
    if poses is None:
        return np.tile(np.eye(4), (count, 1, 1))
    start = np.array(poses, dtype=np.float64)
    if start.shape != (count, 4, 4):
        raise EvaluationError(f"the poses at the start have the shape {start.shape}; expected ({count}, 4, 4)")
    if not is_rigid(start, within=_ROUNDED):
        raise EvaluationError("the poses at the start must be rotations with a shift (0 0 0 1 as last row)")
    return np.linalg.inv(start[0]) @ start


def _size(cloud: PointCloud) -> float:
    return float(np.linalg.norm(np.ptp(cloud.points_mm, axis=0)))


def _opened(cloud: PointCloud | str | os.PathLike[str]) -> PointCloud:
    return loaded_cloud(cloud)


def _name(cloud: PointCloud | str | os.PathLike[str], number: int) -> str:
    return f"scan {number + 1}" if isinstance(cloud, PointCloud) else Path(cloud).stem
