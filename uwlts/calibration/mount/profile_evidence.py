"""Model of a profiler on a platform that observes a fixed artefact: distances, derivatives and weights.

Each artefact is one class. Its start values are in `start_values`, its stored form in `uwlts.model.mount`. The values
of an artefact form an array; its parameters are steps from these values.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.calibration.mount.restricted_likelihood import GroupedEvidence, solve_step
from uwlts.fitting.propagation import differences
from uwlts.model.mount import PlaneFound, SphereFound
from uwlts.optics.window import tilt_direction
from uwlts.shapes.flat import perpendicular_to, unit_vectors
from uwlts.shapes.profile_curves import LEAST_POINTS, Detection, find_arc, find_line
from uwlts.storage.mount_files import Artefact


@dataclass(frozen=True)
class SphereShape:
    """Sphere, in the base frame. Values: centre and radius (4,), mm; an unknown radius is the last parameter."""

    radius_mm: float | None = None

    kind: ClassVar[Artefact] = "sphere"
    fewest_poses: ClassVar[int] = 5
    """Number of poses that makes the problem overdetermined, with two or three equations per pose."""
    flat: ClassVar[bool] = False
    """True if profiles contain nearly straight lines, which determine the rotation of a pose."""

    @property
    def count(self) -> int:
        """Number of parameters."""
        return 3 + (self.radius_mm is None)

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        """Find the artefact in a profile (N, 2), or return None."""
        return find_arc(points, self.radius_mm, rng)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the values after a step (count,)."""
        return values + np.pad(step, (0, 4 - self.count))

    def distances(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return signed distances (N,) of points (N, 3)."""
        return np.linalg.norm(points - values[:3], axis=1) - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return derivatives (N, 3) of the distances by the points."""
        return unit_vectors(points - values[:3])

    def derivatives(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return derivatives (N, count) of the distances by the parameters."""
        return np.hstack([-self.normals(values, points), np.full((len(points), self.count - 3), -1.0)])

    def to_stored(self, values: np.ndarray, radius_std_mm: float | None) -> SphereFound:
        """Return the stored form of the artefact."""
        x, y, z, radius = values.tolist()
        return SphereFound(centre_mm=(x, y, z), radius_mm=radius, radius_std_mm=radius_std_mm)


class PlaneShape:
    """Plane, like `SphereShape`. Values: normal and distance (4,). Parameters: two rotations, and the distance."""

    kind: ClassVar[Artefact] = "plane"
    fewest_poses, flat, count, radius_mm = 8, True, 3, None

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        return find_line(points, rng)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(tilt_direction(values[:3], perpendicular_to(values[:3]), step[:2])[0], values[3] + step[2])

    def distances(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        return points @ values[:3] - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values[:3], points.shape)

    def derivatives(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        return np.column_stack([points @ perpendicular_to(values[:3]).T, np.full(len(points), -1.0)])

    def to_stored(self, values: np.ndarray, radius_std_mm: float | None) -> PlaneFound:
        x, y, z, distance = values.tolist()
        return PlaneFound(normal=(x, y, z), distance_mm=distance)


Shape = SphereShape | PlaneShape


Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""Rotations (P, 3, 3) and positions (P, 3) of the platform in the base frame for a time offset, s."""

_TIME_STEP_S = 1e-4  # for derivatives: short beside any acceleration of a platform
_POINT_MM = (1e-5, 1e2)
"""Bounds of scatter in mm: far below any profiler's resolution, and far above any platform's error."""
_TURN_RAD = (1e-8, 1.0)  # the same for rotations
_ROUNDING = 1e-12  # fraction of the largest variance, above rounding errors that would make covariances singular
_BINS = 32  # bins of a profile, whose points are averaged: a smooth error that changes within a bin acts like noise
_LEAST_SPAN = 1e-6  # fraction of the largest effect of a pose error on its profile below which an effect is ignored
_LEAST_SHARE = 1e-3  # least factor on the noise of a plane's points, reached at a tilt of 0.06 deg from the sheet


@dataclass(frozen=True, eq=False)
class MountState:
    """Values of all unknowns: mount, artefact (see its shape), scale and time offset."""

    rotation: np.ndarray
    translation: np.ndarray
    artefact: np.ndarray
    scale: float = 1.0
    offset_s: float = 0.0


class Scatter(NamedTuple):
    """Standard deviations of a point, the smooth error along a profile, a pose's coordinates, and its rotation.

    The correlation of the smooth error is (1 + d) exp(-d) for a distance of d times ``length_mm``. ``turn_rad`` is
    used for flat artefacts only.
    """

    point_mm: float
    smooth_mm: float
    length_mm: float
    pose_mm: float
    turn_rad: float


@dataclass(frozen=True, eq=False)
class ProfileBins:
    """Bins along P profiles with some numbers of points each."""

    points: np.ndarray  # (P,); numbers of points

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """First point (B,) of each bin, its number of points, its profile, and its number in the profile."""
        bins = np.minimum(_BINS, self.points)
        profiles, places = np.repeat(np.arange(len(bins)), bins), np.concatenate([np.arange(count) for count in bins])
        first = (np.cumsum(self.points) - self.points)[profiles]
        first = first + (places * (self.points / bins)[profiles]).astype(int)
        return first, np.diff(first, append=self.points.sum()), profiles, places

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return means (P, K, ...) of values (N, ...) in bins along the profiles, padded with 0."""
        starts, counts, profiles, places = self._places
        result = np.zeros((len(self.points), int(places.max()) + 1, *values.shape[1:]))
        sums = np.add.reduceat(values, starts, axis=0)
        result[profiles, places] = sums / counts.reshape(-1, *[1] * (values.ndim - 1))
        return result

    @cached_property
    def counts(self) -> np.ndarray:
        """Numbers of points (P, K) in the bins, 0 where a profile has fewer bins."""
        _, sizes, profiles, places = self._places
        counts = np.zeros((len(self.points), int(places.max()) + 1))
        counts[profiles, places] = sizes
        return counts

    def pool_repeats(self, values: np.ndarray) -> tuple[int, float]:
        """Return degrees of freedom and sum of squares of values (N,) about their means in the bins."""
        starts, counts, _, _ = self._places
        means = np.repeat(np.add.reduceat(values, starts) / counts, counts)
        return len(values) - len(starts), float(np.sum((values - means) ** 2))


@dataclass(frozen=True, eq=False)
class Problem(GroupedEvidence[MountState]):
    """Points (n, 3) of every pose in the sensor's frame, mm, and the choice of unknowns.

    The parameters are steps from a `MountState`: translation (3), rotation about the platform's axes (3), those of the
    artefact, then scale and time offset.
    """

    points: Sequence[np.ndarray]
    motion: Motion
    across: np.ndarray
    """Normal (3,) of the sheet in the sensor's frame: points have no noise along it."""
    shape: Shape
    scale: bool = False
    time: bool = False
    table: bool = False

    @cached_property
    def counts(self) -> np.ndarray:
        return np.array([len(each) for each in self.points])

    @cached_property
    def poses(self) -> np.ndarray:
        """Number of each point's pose (N,)."""
        return np.repeat(np.arange(len(self.points)), self.counts)

    @cached_property
    def _all(self) -> np.ndarray:
        return np.vstack(self.points)

    @property
    def values(self) -> int:
        return 6 + self.shape.count + self.scale + self.time

    def rms_mm(self, state: MountState) -> np.ndarray:
        """Return the root mean square distance (P,) of the points of each pose."""
        return np.sqrt(np.bincount(self.poses, self.distances(state) ** 2) / self.counts)

    def select(self, kept: np.ndarray, points: Sequence[np.ndarray] | None = None) -> Self:
        """Return the problem of some poses, optionally with other points of all poses."""
        motion, numbers, given = self.motion, np.arange(len(self.points))[kept], points or self.points
        return replace(
            self,
            points=[given[number] for number in numbers.tolist()],
            motion=lambda offset: tuple(each[numbers] for each in motion(offset)),
        )

    def select_detected(self, seen: Sequence[Detection | None]) -> "Problem":
        """Return the problem of the points on the artefact; poses with None are removed."""
        points = [one if each is None else one[each.members] for one, each in zip(self.points, seen, strict=True)]
        return self.select(np.array([each is not None for each in seen]), points)

    def apply_step(self, state: MountState, step: np.ndarray) -> MountState:
        step = self.free @ step
        turned = Rotation.from_rotvec(step[3:6]).as_matrix() @ state.rotation
        used = 6 + self.shape.count
        artefact = self.shape.apply_step(state.artefact, step[6:used])
        return MountState(
            turned,
            state.translation + step[:3],
            artefact,
            state.scale + (step[used] if self.scale else 0.0),
            state.offset_s + (step[used + self.scale] if self.time else 0.0),
        )

    def distances(self, state: MountState, step: np.ndarray | None = None) -> np.ndarray:
        """Return signed distances (N,) of all points from the artefact, mm, after a step from a state."""
        state = state if step is None else self.apply_step(state, step)
        return self.shape.distances(state.artefact, self.to_base(state))

    def to_base(self, state: MountState) -> np.ndarray:
        """Transform all points to the base frame; return (N, 3), mm."""
        rotations, positions = self.motion(state.offset_s)
        platform = self._all @ state.rotation.T + state.translation
        return np.einsum("nij,nj->ni", rotations[self.poses], platform) + state.scale * positions[self.poses]

    def pose_error_derivatives(self, state: MountState) -> np.ndarray:
        """Return derivatives (N, K) of the distances by the error of their pose.

        A pose error is a shift in three directions of the base. For flat artefacts, a rotation about the middle of the
        profile is added. (For a sphere, a rotation is equivalent to a shift of its centre.)
        """
        normals = self.shape.normals(state.artefact, self.to_base(state))
        if not self.shape.flat:
            return normals
        middles = np.repeat([profile.mean(axis=0) for profile in self.points], self.counts, axis=0)
        arms = np.einsum("nij,nj->ni", self.motion(state.offset_s)[0][self.poses] @ state.rotation, self._all - middles)
        return self.project_on_lines(np.hstack([normals, np.cross(arms, normals)]))

    def derivatives(self, state: MountState) -> np.ndarray:
        """Return derivatives (N, size) of the distances at a state by the parameters."""
        return self._compute_derivatives(state) @ self.free

    def normals(self, state: MountState) -> np.ndarray:
        """Return derivatives (N, 3) of the distances by the points, along the axes of the sensor."""
        rotations = self.motion(state.offset_s)[0]
        outward = self.shape.normals(state.artefact, self.to_base(state))
        return np.einsum("nij,ni->nj", rotations[self.poses], outward) @ state.rotation

    def _compute_derivatives(self, state: MountState) -> np.ndarray:
        """Return derivatives (N, K) by all values."""
        rotations, positions = self.motion(state.offset_s)
        turned, base = self._all @ state.rotation.T, self.to_base(state)
        normals = self.shape.normals(state.artefact, base)
        in_platform = np.einsum("nij,ni->nj", rotations[self.poses], normals)
        columns = [in_platform, np.cross(turned, in_platform)]
        columns.append(self.shape.derivatives(state.artefact, base))
        if self.scale:
            columns.append(np.sum(normals * positions[self.poses], axis=1, keepdims=True))
        if self.time:
            at, step = np.array([state.offset_s]), np.array([_TIME_STEP_S])
            moved = differences(lambda s: self.to_base(replace(state, offset_s=float(s[0]))), at, step)
            columns.append(np.sum(normals * moved.reshape(-1, 3), axis=1, keepdims=True))
        return self.project_on_lines(np.hstack(columns))

    @cached_property
    def _lines(self) -> list[np.ndarray]:
        """Orthonormal bases (n, 2) of the noise-free changes of each profile of a flat artefact."""
        bases = []
        for profile in self.points:
            centred = profile - profile.mean(axis=0)
            along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
            bases.append(np.linalg.qr(np.column_stack([np.ones(len(along)), along]))[0])
        return bases

    def project_on_lines(self, values: np.ndarray) -> np.ndarray:
        """Project values (N, ...) of a flat artefact onto the lines of the profiles; return others unchanged.

        Without the projection, a plane far from the true one could fit the points' noise.
        """
        if not self.shape.flat:
            return values
        parts = zip(self._lines, np.split(values, np.cumsum(self.counts)[:-1]), strict=True)
        return np.concatenate([basis @ (basis.T @ part) for basis, part in parts])

    def noise_along(self, state: MountState) -> np.ndarray:
        """Return the fraction (N, 1) of the points' noise (in the sheet) that changes their distances.

        The fraction is small for a plane at a small angle to the sheet. Without it, a plane along the sheet would seem
        to fit without noise. Spheres are cut near their middle, where the fraction is 1.
        """
        if not self.shape.flat:
            return np.ones((len(self.poses), 1))
        out_of_sheet = self.normals(state) @ self.across
        return np.sqrt(np.maximum(1 - out_of_sheet**2, _LEAST_SHARE**2))[:, None]

    @cached_property
    def _bins(self) -> ProfileBins:
        return ProfileBins(self.counts)

    @cached_property
    def _apart(self) -> np.ndarray:
        """Distances (P, K, K) between the bins of each profile, mm."""
        middles = self._bins.means(self._all)
        return np.linalg.norm(middles[:, :, None] - middles[:, None], axis=3)

    def bounds(self) -> np.ndarray:
        """Return bounds (5, 2) of `Scatter`."""
        there, far = self._bins.counts > 0, self._apart
        both = (there[:, :, None] & there[:, None])[:, 1:, :-1]
        beside = float(np.median(np.diagonal(far[:, 1:, :-1], axis1=1, axis2=2)[np.diagonal(both, axis1=1, axis2=2)]))
        longest = max(float(np.max(far[:, 1:, :-1][both])), 2 * beside)
        turn = _TURN_RAD if self.shape.flat else (_TURN_RAD[0],) * 2
        return np.array([_POINT_MM, _POINT_MM, (beside / 2, longest), _POINT_MM, turn])

    def basis(self, state: MountState) -> np.ndarray:
        """Return orthonormal bases (P, K, q), padded with 0, of the changes of each profile that the unknowns cause.

        The unknowns are the errors of the pose and the parameters.
        """
        if self._last_basis and self._last_basis[0][0] is state:
            return self._last_basis[0][1]
        changes = self.pose_error_derivatives(state)
        if self.shape.flat:
            # Shifts change the profile of a sphere as all parameters do. Noise would make the columns differ.
            changes = np.hstack([changes, self.derivatives(state)])
        means = self._bins.means(changes)
        sizes = np.linalg.norm(means, axis=1, keepdims=True).clip(1e-30)
        basis, spans, _ = np.linalg.svd(means / sizes, full_matrices=False)
        used = spans > _LEAST_SPAN * spans[:, :1]
        basis = (basis * used[:, None])[:, :, : int(used.sum(axis=1).max())]
        self._last_basis[:] = [(state, basis)]
        return basis

    @cached_property
    def _last_basis(self) -> list[tuple[MountState, np.ndarray]]:
        """State and basis of the last call: the steps of one fit share a state."""
        return []

    def project(self, state: MountState, values: np.ndarray) -> np.ndarray:
        """Return the coordinates (P, q, ...) of changes (N, ...) of the distances, by unweighted least squares."""
        means, across = self._bins.means(values), np.swapaxes(self.basis(state), 1, 2)
        return across @ means if means.ndim == 3 else (across @ means[:, :, None])[:, :, 0]

    def residuals(self, state: MountState, step: np.ndarray | None = None) -> np.ndarray:
        """Return the coordinates (P, q) of the distances after a step; the noise off their lines is unchanged.

        Weighting the bins of a profile would rely on a model of its smooth error, mostly on its ends.
        """
        here = self.distances(state)
        return self.project(
            state, here if step is None else here + self.project_on_lines(self.distances(state, step) - here)
        )

    def jacobian(self, state: MountState, step: np.ndarray | None = None) -> np.ndarray:
        if step is None:
            return self.project(state, self.derivatives(state))
        derivatives = self._compute_derivatives(self.apply_step(state, step))
        derivatives[:, 3:6] = derivatives[:, 3:6] @ _compute_left_jacobian((self.free @ step)[3:6])
        return self.project(state, derivatives @ self.free)

    def covariance(self, state: MountState) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
        counts, distances = self._bins.counts, self._apart
        basis, share = self.basis(state), self._bins.means(self.noise_along(state))
        by_bins = np.swapaxes(share * basis, 1, 2)
        by_points = by_bins / np.sqrt(np.maximum(counts, 1))[:, None]
        errors = self.project(state, self.pose_error_derivatives(state))
        noise, shifts, turns = (one @ np.swapaxes(one, 1, 2) for one in (by_points, errors[:, :, :3], errors[:, :, 3:]))
        filled = np.eye(basis.shape[2]) * np.logical_not(basis.any(axis=1))[:, :, None]

        def covariances(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            scatter = Scatter(*np.exp(logs))
            far = distances / scatter.length_mm
            falling = scatter.smooth_mm**2 * np.exp(-far)
            smooth, longer = (by_bins @ (falling * each) @ np.swapaxes(by_bins, 1, 2) for each in (1 + far, far**2))
            parts = [scatter.point_mm**2 * noise, smooth, scatter.pose_mm**2 * shifts, scatter.turn_rad**2 * turns]
            changes = [2 * parts[0], 2 * smooth, longer, 2 * parts[2], 2 * parts[3]]
            total = np.sum(parts, axis=0)
            largest = np.max(np.diagonal(total, axis1=1, axis2=2), axis=1)
            rounding = _ROUNDING * largest[:, None, None] * np.eye(total.shape[1])
            return total + filled + rounding, np.array(changes)

        return covariances

    def pool_repeats(self, state: MountState) -> tuple[int, float]:
        """Return degrees of freedom and sum of squares of the points' noise within the bins."""
        return self._bins.pool_repeats(self.distances(state) / self.noise_along(state)[:, 0])

    def pose_directions(self, state: MountState) -> list[np.ndarray]:
        return [np.eye(each.shape[1])[:, each.any(axis=0)] for each in self.basis(state)]

    def solve(self, state: MountState, scatter: Scatter | None = None) -> MountState:
        """Minimise the weighted squares of all distances with a robust loss (Cauchy), or the squares without one."""
        covariances, _ = self.covariance(state)(np.log(scatter or (1.0, *[_POINT_MM[0]] * 4)))
        return self.apply_step(state, solve_step(self, state, covariances, loss="cauchy" if scatter else "linear"))


def thin(points: np.ndarray, most: int) -> np.ndarray:
    """Return at most ``most`` evenly chosen rows."""
    return points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(int)]


def to_sheet(points: Sequence[np.ndarray], sheet: np.ndarray) -> list[np.ndarray]:
    """Return coordinates x and z (n, 2) in the sheet of points (n, 3); ``sheet`` (4, 4) maps to the sensor's frame."""
    return [((each - sheet[:3, 3]) @ sheet[:3, :3])[:, [0, 2]] for each in points]


def from_sheet(flat: np.ndarray) -> np.ndarray:
    """Return points or directions (n, 3) in the frame of the sheet from their x and z (n, 2)."""
    return np.column_stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]])


def _compute_left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Return the derivative of exp(v + dv) exp(-v) by dv, a rotation vector (arXiv:1812.01537, eq. 145)."""
    angle, cross = float(np.linalg.norm(vector)), np.cross(np.eye(3), vector)
    if angle < 1e-6:
        return np.eye(3) + cross / 2
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross


def detect_again(
    problem: Problem, state: MountState, flat: Sequence[np.ndarray], reach_mm: float, rng: np.random.Generator
) -> list[Detection | None]:
    """Find the artefact again in the profiles (N, 2) of all poses, near its place in a state; else None."""
    found: list[Detection | None] = []
    for points, off in zip(flat, np.split(problem.distances(state), np.cumsum(problem.counts)[:-1]), strict=True):
        near = np.abs(off) < reach_mm
        seen = problem.shape.find(points[near], rng)
        seen = seen and seen.expand(near).without_isolated(points)
        found.append(seen if seen is not None and seen.members.sum() >= LEAST_POINTS else None)
    return found
