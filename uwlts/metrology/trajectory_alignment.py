"""Self-consistency of a scan along a path: a smooth correction of the path, by surfaces that it shows more than once.

Unknown is a correction of every pose, a shift (mm) and a turn (rad) in the base frame about the platform, as a cubic
B-spline in time. Known beforehand is by how much a navigation drifts from an exact start: by a steady rate (a bias of
velocity or gyroscope), by a rate that wanders (its instability), and by a random walk (noise of the velocity). Which
shares of the variance these have is what makes the evidence likeliest (empirical Bayes: MacKay, Neural Computation 4,
1992): a random walk also bends what is seen within a crossing. Residuals are distances between patches of the surface
where the path crosses itself.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from uwlts.metrology.height_correlation import shifts_of_heights
from uwlts.metrology.joint_registration import JointRegistration
from uwlts.metrology.patches import (
    PatchDistances,
    Patches,
    averaged_points,
    disc_radius,
    distances_between,
    scatter,
    surface_patches,
)
from uwlts.metrology.path_uncertainty import along_corrected_path
from uwlts.model.errors import EvaluationError
from uwlts.model.sensor import Table
from uwlts.model.trajectory import Trajectory, on_clock
from uwlts.storage.cloud import PointCloud, read_cloud

_TUKEY = 4.685
_VOXEL = 0.4
"""Of the radius of patches: points for a search by features."""
_INTERVALS = 100
"""Of the spline: between two knots a random walk goes a tenth of the drift of the whole path."""
_SMOOTH, _ROUGH = (0.3, 0.01), (0.2, 0.4)
"""Shares of wandering rate and random walk with which crossings are searched, one after the other: a path that hardly
bends is told apart from false crossings best, and one that bends much is found with the other shares only."""
_SHARES = [
    (wander, walk)
    for wander in (0.003, 0.01, 0.03, 0.1, 0.3, 0.6)
    for walk in (1e-5, 1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 0.6)
    if wander + walk <= 0.9
]
_LEARNED = 4
"""Times the shares are estimated: matches and weights follow them."""
_FEWEST = 30
"""Patches of a piece, and of a crossing."""
_ROUNDS = 15
_SIGMAS = 3.0
"""How far, in standard deviations of the drift, a crossing is searched."""
_REFINED = 12
"""Rounds of a pair's own estimate."""
_STILL_MM = 1e-3
_EXACT_MM, _EXACT_RAD = 1e-3, 1e-7
"""Standard uncertainty of the start of the path, which is the frame's: as good as exact."""
_HELD_OUT = 5
"""Every fifth cube of a crossing, of four radii, is held out and judges the gain."""
_SHARE = 0.6
"""Of the patches of a crossing, those that agree within five of their standard deviations."""


@dataclass(frozen=True)
class Crossing:
    """Where a path shows a surface again: times of both passes, patches, and distances in mm.

    ``before_mm`` and ``after_mm`` are root mean square distances of the patches near each other by the path as it was
    and as it is. ``held_out_before_mm`` and ``held_out_after_mm`` are of patches that the estimate has not used.
    ``missed_mm`` is the shift by which the navigation missed here.
    """

    times_s: tuple[float, float]
    patches: int
    before_mm: float
    after_mm: float
    held_out_before_mm: float
    held_out_after_mm: float
    missed_mm: float


@dataclass(frozen=True, eq=False)
class AlignedTrajectory:
    """A path that agrees with the surfaces that it shows.

    Attributes
    ----------
    trajectory : Trajectory
        Corrected poses at the times of the given ones, with the covariance of each.
    correction : (N, 6) float64
        Shift (mm) and turn (rad) that each pose was given.
    crossings : tuple of Crossing
    cloud : PointCloud
        The cloud along the corrected path. Its uncertainty is that of the corrected path, and what the given cloud's
        holds of the calibrations of sensor and mount.
    """

    trajectory: Trajectory
    correction: np.ndarray
    crossings: tuple[Crossing, ...]
    cloud: PointCloud = field(repr=False)

    def record(self) -> Table:
        """Crossings and size of the correction as JSON."""
        shift, turn = (np.linalg.norm(part, axis=1) for part in (self.correction[:, :3], self.correction[:, 3:]))
        return {
            "largest_shift_mm": float(shift.max()),
            "largest_turn_deg": float(np.degrees(turn.max())),
            "crossings": [
                {name: list(value) if isinstance(value, tuple) else value for name, value in vars(each).items()}
                for each in self.crossings
            ],
        }

    def lines(self) -> list[str]:
        """The summary as text."""
        known = self.record()
        lines = [
            f"path corrected by up to {known['largest_shift_mm']:.3f} mm and {known['largest_turn_deg']:.4f} deg, "
            f"{len(self.crossings)} crossings"
        ]
        for each in self.crossings:
            first, second = each.times_s
            lines.append(
                f"  {first:.1f} s and {second:.1f} s: {each.patches} patches, missed by {each.missed_mm:.2f} mm; rms "
                f"{each.before_mm:.3f} to {each.after_mm:.4f} mm, held out {each.held_out_before_mm:.3f} to "
                f"{each.held_out_after_mm:.4f} mm"
            )
        return lines


def align_trajectory(
    cloud: PointCloud | str | os.PathLike[str],
    trajectory: Trajectory,
    *,
    clock_offset_s: float = 0.0,
    clock_drift_ppm: float = 0.0,
    drift_mm: float | None = None,
    drift_deg: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> AlignedTrajectory:
    """Correct a trajectory so that surfaces which it shows twice agree, and move the cloud with it.

    Parameters
    ----------
    cloud
        Cloud or its file, in the base frame by the trajectory, with the time of each point (`reconstruct`).
    trajectory
        Path of the platform (of the sensor without a mount).
    clock_offset_s, clock_drift_ppm
        What to add to the times of the points for those of the trajectory, and by how many parts in a million its clock
        runs faster than theirs.
    drift_mm, drift_deg
        Standard uncertainty that the navigation has gathered at the end, along each axis; from the covariance of the
        trajectory unless given.

    Raises
    ------
    CaptureError
        The file cannot be read.
    DescriptionError
        Points were measured before or after the trajectory.
    EvaluationError
        Points have no times, the drift is not known, or the path shows no surface twice that tells where it is.
    """
    cloud = cloud if isinstance(cloud, PointCloud) else read_cloud(cloud)
    if cloud.time_s is None:
        raise EvaluationError("the cloud has no times of its points: reconstruct it with a trajectory")
    times = on_clock(cloud.time_s, offset_s=clock_offset_s, drift_ppm=clock_drift_ppm)
    path = _Path.of(trajectory, _drift(trajectory, drift_mm, drift_deg), times)
    pieces = _pieces(cloud, times, path)
    searched = [_Alignment(pieces, path, shares) for shares in (_SMOOTH, _ROUGH)]
    for turn, joint in enumerate(searched):
        for number in range(len(pieces)):
            joint.close_with_earlier(number)
            progress(turn * len(pieces) + number + 1, len(searched) * len(pieces))
        if joint.pairs:
            joint.settle()
    joint = max(searched, key=lambda each: each.agreeing())
    if not joint.pairs:
        raise EvaluationError(
            f"the path shows no surface twice, within {_SIGMAS:g} standard deviations of its drift, that tells where "
            "it is: cross an earlier part of the path over a surface with features"
        )
    return joint.result(cloud, trajectory, times)


def _drift(trajectory: Trajectory, drift_mm: float | None, drift_deg: float | None) -> tuple[float, float]:
    if (drift_mm is None) != (drift_deg is None):
        raise EvaluationError("the drift needs both parts: drift_mm and drift_deg")
    if drift_mm is not None and drift_deg is not None:
        if not (0 < drift_mm < np.inf and 0 < drift_deg < 90):
            raise EvaluationError(f"the drift is {drift_mm:g} mm and {drift_deg:g} deg; expected positive numbers")
        return drift_mm, float(np.radians(drift_deg))
    if trajectory.covariance is None:
        raise EvaluationError("the trajectory states no covariance: give drift_mm and drift_deg")
    variance = np.einsum("nii->ni", trajectory.covariance)
    grown = np.maximum(variance.max(axis=0) - variance[0], 0.0)
    shift, turn = np.sqrt(grown[:3].max()), np.sqrt(grown[3:].max())
    return max(float(shift), _EXACT_MM), max(float(turn), _EXACT_RAD)


@dataclass(frozen=True, eq=False)
class _Path:
    """A trajectory, the knots of the spline over the time of the points, and the drift at its end, mm and rad."""

    trajectory: Trajectory
    knots: np.ndarray
    drift: tuple[float, float]
    first_s: float
    last_s: float

    @classmethod
    def of(cls, trajectory: Trajectory, drift: tuple[float, float], times: np.ndarray) -> _Path:
        first, last = float(times.min()), float(times.max())
        inner = np.linspace(first, last, _INTERVALS + 1)
        knots = np.concatenate([np.repeat(first, 3), inner, np.repeat(last, 3)])
        return cls(trajectory, knots, drift, first, last)

    @property
    def count(self) -> int:
        return len(self.knots) - 4

    def basis(self, times: np.ndarray) -> np.ndarray:
        """Weights (N, C) of the coefficients at times (N,)."""
        inside = np.clip(times, self.first_s, self.last_s)
        return BSpline.design_matrix(inside, self.knots, 3).toarray()

    def information(self, shares: tuple[float, float]) -> np.ndarray:
        """Inverse covariance (6 C, 6 C) of the coefficients, ordered coefficient by coefficient.

        ``shares`` of the variance at the end are those of a wandering rate and of a random walk.
        """
        # A coefficient stands for the correction at the mean of its knots (Greville).
        at = np.array([self.knots[k + 1 : k + 4].mean() for k in range(self.count)])
        t = (at - self.first_s) / (self.last_s - self.first_s)
        first, second = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
        # A rate that walks at random, from zero: the integral of a random walk.
        wandering = first**2 * (3 * second - first) / 2
        shape = (1 - sum(shares)) * np.outer(t, t) + shares[0] * wandering + shares[1] * first
        parts = []
        for size, exact in zip(self.drift, (_EXACT_MM, _EXACT_RAD), strict=True):
            parts += [np.linalg.inv(size**2 * shape + (exact**2 + 1e-10 * size**2) * np.eye(len(t)))] * 3
        result = np.zeros((6 * len(t),) * 2)
        for component, part in enumerate(parts):
            result[component::6, component::6] = part
        return result


@dataclass(frozen=True, eq=False)
class _Piece:
    """A part of the path: patches of its surface, their times (P,), the platform's places (P, 3) then, and its points.

    ``held_out`` (P,) are patches that judge the gain, ``points_mm`` (N, 3) all points by the path as it was, and
    ``patch_of`` (N,) the patch nearest to each.
    """

    patches: Patches
    times_s: np.ndarray
    platform_mm: np.ndarray
    held_out: np.ndarray
    points_mm: np.ndarray
    patch_of: np.ndarray

    @property
    def middle_s(self) -> float:
        return float(np.median(self.times_s))


def _pieces(cloud: PointCloud, times: np.ndarray, path: _Path) -> list[_Piece]:
    """Parts of the path about as long as the stripe is wide."""
    frames = np.unique(times)
    order = np.argsort(times, kind="stable")
    sorted_times = times[order]
    starts = np.searchsorted(sorted_times, frames)
    ends = np.append(starts[1:], len(times))
    widths = [np.linalg.norm(np.ptp(cloud.points_mm[order[a:b]], axis=0)) for a, b in zip(starts, ends, strict=True)]
    swath = float(np.median(widths))
    middles = np.array([cloud.points_mm[order[a:b]].mean(axis=0) for a, b in zip(starts, ends, strict=True)])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(middles, axis=0), axis=1)))
    count = max(2, round(way[-1] / swath))
    number = np.minimum((way / way[-1] * count).astype(int), count - 1)
    of_piece = number[np.searchsorted(frames, sorted_times)]
    radius = disc_radius(cloud.points_mm[order[of_piece == count // 2]])
    pieces = []
    for k in range(count):
        own = order[of_piece == k]
        known = None if cloud.uncertainty is None else cloud.uncertainty[own]
        # What all points share does not tell one pass from another along a path.
        known = None if known is None else replace(known, patterns_mm=known.patterns_mm[:0], poses_mm=None)
        if len(own) < 200:
            continue
        try:
            patches = surface_patches(cloud.points_mm[own], known, radius_mm=radius)
        except EvaluationError:
            continue
        at = times[own][patches.numbers]
        cubes = np.floor(patches.places_mm / (4 * radius)).astype(np.int64)
        held_out = (cubes @ np.array([1, 2, 3])) % _HELD_OUT == 0
        points = averaged_points(cloud.points_mm[own], radius * _VOXEL)
        near: Any = patches.tree.query(points)
        pieces.append(_Piece(patches, at, path.trajectory.poses_at(at)[:, :3, 3], held_out, points, near[1]))
    return pieces


class _Alignment:
    """Coefficients of the correction, and the pairs of pieces that cross."""

    def __init__(self, pieces: list[_Piece], path: _Path, shares: tuple[float, float]) -> None:
        self.pieces, self.path, self.shares = pieces, path, shares
        self.prior = path.information(shares)
        self.coefficients = np.zeros(6 * path.count)
        self.covariance = np.linalg.inv(self.prior)
        self.bases = [path.basis(piece.times_s) for piece in pieces]
        self.pairs: list[tuple[int, int]] = []

    def corrections(self, basis: np.ndarray) -> np.ndarray:
        """Shift and turn (N, 6) by weights (N, C)."""
        return basis @ self.coefficients.reshape(-1, 6)

    def moved(self, number: int) -> Patches:
        """Patches of a piece along the path as it is now."""
        piece, correction = self.pieces[number], self.corrections(self.bases[number])
        rotation = Rotation.from_rotvec(correction[:, 3:])
        places = rotation.apply(piece.patches.places_mm - piece.platform_mm) + piece.platform_mm + correction[:, :3]
        axes = np.einsum("pij,pkj->pki", rotation.as_matrix(), piece.patches.axes)
        return replace(piece.patches, places_mm=places, axes=axes, one_sided=False)

    def relative_std(self, first: int, second: int) -> np.ndarray:
        """Standard uncertainty (6,) of the correction of one piece less that of another."""
        rows = self.path.basis(np.array([self.pieces[first].middle_s, self.pieces[second].middle_s]))
        by = np.kron(rows[1] - rows[0], np.eye(6))
        return np.sqrt(np.maximum(np.diag(by @ self.covariance @ by.T), 0.0))

    def close_with_earlier(self, number: int) -> None:
        """Search what a piece shows again of earlier ones, and correct the path by it."""
        own = self.moved(number)
        low, high = own.places_mm.min(axis=0), own.places_mm.max(axis=0)
        for earlier in range(number - 2):
            std = self.relative_std(earlier, number)
            other = self.moved(earlier)
            lever = float(np.linalg.norm(high - low))
            reach = _SIGMAS * (std[:3] + lever * std[3:].max())
            apart = np.maximum(low - reach - other.places_mm.max(axis=0), other.places_mm.min(axis=0) - high - reach)
            if (apart > 0).any():
                continue
            start = self._start(number, earlier, reach)
            if start is None:
                continue
            self.pairs.append((earlier, number))
            if not self._estimated(seed={(earlier, number): start}):
                self.pairs.pop()
            own = self.moved(number)

    def _start(self, number: int, earlier: int, reach: np.ndarray) -> np.ndarray | None:
        """Pose (4, 4) in which a piece lies best on an earlier one; None where it lies nowhere within reach (3,).

        Maps of the heights of both, with what lies beside them on the path, are correlated for all shifts.
        """
        own, other = self.moved(number), self.moved(earlier)
        normal = np.linalg.eigh(other.normals.T @ other.normals)[1][:, 2]
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        frame = np.stack([first, np.cross(normal, first), normal])
        beside = [range(max(0, k - 1), min(len(self.pieces), k + 2)) for k in (number, earlier)]
        clouds = [np.vstack([self._points(k) for k in near]) @ frame.T for near in beside]
        best: tuple[float, np.ndarray] | None = None
        for shift in shifts_of_heights(*clouds, pixel_mm=0.5 * own.radius_mm, reach_mm=np.abs(frame) @ reach):
            pose = np.eye(4)
            pose[:3, 3] = shift @ frame
            refined = self._refined(own, other, pose)
            if refined is not None and (best is None or refined[0] > best[0]):
                best = refined
        return None if best is None else best[1]

    def _points(self, number: int) -> np.ndarray:
        """Points (N, 3) of a piece along the path as it is now."""
        piece = self.pieces[number]
        correction, platform = self.corrections(self.bases[number])[piece.patch_of], piece.platform_mm[piece.patch_of]
        turned = Rotation.from_rotvec(correction[:, 3:]).apply(piece.points_mm - platform)
        return turned + platform + correction[:, :3]

    def _refined(self, own: Patches, other: Patches, pose: np.ndarray) -> tuple[float, np.ndarray] | None:
        """Number of patches that agree, and pose (4, 4), after a pair's own estimate from a pose.

        Pieces are bent by what the navigation drifts within them; the estimate of the path is the judge in the end.
        """
        joint = JointRegistration([other, own], [[], []], np.array([np.eye(4), pose]), start_std=None, sphere_mm=None)
        reach = 4 * own.radius_mm
        for _ in range(_REFINED):
            if not (pairs := joint.evidence(reach)):
                return None
            step = joint.solved(list(pairs.values())).step
            joint.move(step)
            reach = max(0.8 * reach, own.radius_mm)
        if not (pairs := joint.evidence(reach)) or len(joint.solved(list(pairs.values())).open_directions):
            return None
        found = distances_between(own, joint.poses[1], other, np.eye(4), reach_mm=reach)
        bent = self.path.drift[0] / len(self.pieces)
        fits = np.abs(found.distance_mm) < np.maximum(5 * found.std_mm, bent)
        if np.count_nonzero(fits) < _FEWEST or np.mean(fits) < _SHARE:
            return None
        return float(np.count_nonzero(fits)), joint.poses[1]

    def _estimated(self, seed: dict[tuple[int, int], np.ndarray]) -> bool:
        """Estimate the correction anew; whether the last pair agrees then.

        Poses that a search has found, by their pairs, give the first matches.
        """
        before = self.coefficients.copy(), self.covariance
        for done in range(_ROUNDS):
            largest = self._round(seed if done == 0 else {}, reach_mm=self._reach())
            if largest < _STILL_MM and done > 1:
                break
        if self._agrees(self.pairs[-1]):
            return True
        self.coefficients, self.covariance = before
        return False

    def _agrees(self, pair: tuple[int, int]) -> bool:
        fits = self._fits(pair)
        return bool(np.count_nonzero(fits) >= _FEWEST and np.mean(fits) > _SHARE)

    def _fits(self, pair: tuple[int, int]) -> np.ndarray:
        """Whether each match (Q,) of a pair agrees within five of its standard deviations."""
        a, b = pair
        found = distances_between(self.moved(b), np.eye(4), self.moved(a), np.eye(4), reach_mm=self._reach())
        return np.abs(found.distance_mm) < 5 * found.std_mm

    def agreeing(self) -> int:
        """Number of patches that agree in all crossings."""
        return sum(int(np.count_nonzero(self._fits(pair))) for pair in self.pairs)

    def settle(self) -> None:
        """Estimate the path and the shares of its drift by turns; pairs that do not agree then are given up."""
        for _ in range(_LEARNED):
            self._settled()
            if (shares := self._likeliest()) == self.shares:
                break
            self.shares, self.prior = shares, self.path.information(shares)
        self._settled()
        if len(agreeing := [pair for pair in self.pairs if self._agrees(pair)]) < len(self.pairs):
            self.pairs = agreeing
            self._settled()

    def _settled(self) -> None:
        """Estimate until nothing moves any more."""
        for _ in range(_ROUNDS):
            if self._round({}, reach_mm=self._reach()) < _STILL_MM:
                break

    def _likeliest(self) -> tuple[float, float]:
        """Shares of the drift with which the matches as they are now are likeliest."""
        normal, gradient = self._evidence({}, reach_mm=self._reach())
        at = normal @ self.coefficients - gradient

        def likelihood(shares: tuple[float, float]) -> float:
            """Twice the logarithm, but for what all shares have in common: the path is integrated out."""
            prior = self.path.information(shares)
            together = normal + prior
            sizes = [np.linalg.slogdet(each)[1] for each in (prior, together)]
            return float(at @ np.linalg.solve(together, at) + sizes[0] - sizes[1])

        return max(_SHARES, key=likelihood)

    def _reach(self) -> float:
        return 2 * self.pieces[0].patches.radius_mm

    def _round(self, seed: dict[tuple[int, int], np.ndarray], *, reach_mm: float) -> float:
        """One step of least squares; returns the largest shift of a coefficient."""
        normal, gradient = self._evidence(seed, reach_mm=reach_mm)
        normal, gradient = normal + self.prior, gradient + self.prior @ self.coefficients
        step = -np.linalg.solve(normal, gradient)
        self.coefficients = self.coefficients + step
        self.covariance = np.linalg.inv(normal)
        return float(np.abs(step.reshape(-1, 6)[:, :3]).max())

    def _evidence(self, seed: dict[tuple[int, int], np.ndarray], *, reach_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and gradient of the distances between all pairs, without what is known beforehand."""
        normal, gradient = np.zeros_like(self.prior), np.zeros_like(self.coefficients)
        for pair in self.pairs:
            a, b = pair
            moved, pose = (self.moved(a), self.moved(b)), seed.get(pair, np.eye(4))
            for source, target in ((b, a), (a, b)):
                poses = (pose, np.eye(4)) if source == b else (np.eye(4), pose)
                found = distances_between(moved[source == b], poses[0], moved[target == b], poses[1], reach_mm=reach_mm)
                used = np.logical_not(self.pieces[source].held_out[found.source])
                used &= np.logical_not(self.pieces[target].held_out[found.target])
                if np.count_nonzero(used) < _FEWEST // 2:
                    continue
                residual, rows = self._residuals(found, used, source, target, poses, moved)
                std = found.std_mm[used]
                spread = scatter(residual / std) if pair not in seed else 1.0
                u = np.clip(residual / (std * spread * _TUKEY), -1, 1)
                robust = (1 - u * u) ** 2 if pair not in seed else np.ones(len(u))
                weight = robust / (std * spread) ** 2 / (2 * moved[source == b].shared)
                normal += rows.T @ (weight[:, None] * rows)
                gradient += rows.T @ (weight * residual)
        return normal, gradient

    def _residuals(
        self,
        found: PatchDistances,
        used: np.ndarray,
        source: int,
        target: int,
        poses: tuple[np.ndarray, np.ndarray],
        moved: tuple[Patches, Patches],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances (Q,) of matched patches as they lie now, and their derivatives (Q, 6 C) by the coefficients."""
        rows_s, rows_t = found.source[used], found.target[used]
        normals, places = found.normals[used], found.places_mm[used]
        residual = found.distance_mm[used]
        seeded = next((each for each in poses if not np.allclose(each, np.eye(4))), None)
        if seeded is not None:
            # Matched by another pose than the present one: from the places as they lie now.
            second = seeded is poses[0]
            back = np.linalg.inv(seeded)
            gap = np.einsum("qi,qi->q", places @ back[:3, :3].T + back[:3, 3] - places, normals)
            residual = residual + gap if second else residual - gap
        derivatives = np.zeros((len(residual), 6 * self.path.count))
        for number, rows, sign in ((source, rows_s, 1.0), (target, rows_t, -1.0)):
            piece, basis = self.pieces[number], self.bases[number][rows]
            # Turns are about the platform where the present correction has it.
            platform = piece.platform_mm[rows] + self.corrections(basis)[:, :3]
            lever = moved[int(number == max(source, target))].places_mm[rows] - platform
            by = np.hstack([normals, np.cross(lever, normals)])
            derivatives += sign * np.einsum("qc,qi->qci", basis, by).reshape(len(rows), -1)
        return residual, derivatives

    def result(self, cloud: PointCloud, trajectory: Trajectory, times: np.ndarray) -> AlignedTrajectory:
        basis = self.path.basis(trajectory.times_s)
        correction = self.corrections(basis)
        poses = trajectory.poses.copy()
        poses[:, :3, :3] = Rotation.from_rotvec(correction[:, 3:]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += correction[:, :3]
        blocks = self.covariance.reshape(self.path.count, 6, self.path.count, 6)
        covariance = np.einsum("nc,cidj,nd->nij", basis, blocks, basis, optimize=True)
        covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
        moments, image = np.unique(times, return_inverse=True)
        at_image = self.path.basis(moments)
        by_point = self.corrections(at_image)[image]
        platform = trajectory.poses_at(moments)[image, :3, 3]
        levers = Rotation.from_rotvec(by_point[:, 3:]).apply(cloud.points_mm - platform)
        known = cloud.uncertainty
        if known is not None:
            known = along_corrected_path(known, by_point[:, 3:], levers, image, at_image, self.covariance)
        crossings = tuple(self._crossing(pair) for pair in self.pairs)
        return AlignedTrajectory(
            Trajectory(trajectory.times_s, poses, covariance),
            correction,
            crossings,
            replace(cloud, points_mm=levers + platform + by_point[:, :3], uncertainty=known),
        )

    def _crossing(self, pair: tuple[int, int]) -> Crossing:
        a, b = pair
        now = distances_between(self.moved(b), np.eye(4), self.moved(a), np.eye(4), reach_mm=self._reach())
        one = self.pieces[a], self.pieces[b]
        normals = now.normals
        # The same patches, as they lay by the path as it was.
        shift = self.moved(b).places_mm[now.source] - one[1].patches.places_mm[now.source]
        shift -= self.moved(a).places_mm[now.target] - one[0].patches.places_mm[now.target]
        before = now.distance_mm - np.einsum("qi,qi->q", shift, normals)
        held = one[1].held_out[now.source] | one[0].held_out[now.target]
        inside = np.abs(now.distance_mm) < 5 * now.std_mm * scatter(now.distance_mm / now.std_mm)

        def rms(values: np.ndarray, which: np.ndarray) -> float:
            return float(np.sqrt(np.mean(values[which] ** 2))) if which.any() else 0.0

        return Crossing(
            times_s=(one[0].middle_s, one[1].middle_s),
            patches=int(np.count_nonzero(inside & ~held)),
            before_mm=rms(before, inside & ~held),
            after_mm=rms(now.distance_mm, inside & ~held),
            held_out_before_mm=rms(before, inside & held),
            held_out_after_mm=rms(now.distance_mm, inside & held),
            missed_mm=float(np.linalg.norm(np.median(shift, axis=0))),
        )
