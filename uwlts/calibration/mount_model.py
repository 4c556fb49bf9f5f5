"""Model of a profiler on a platform before a fixed artefact: distances, derivatives and weights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from uwlts.calibration.mount_artefacts import Seen, Shape
from uwlts.calibration.mount_profiles import LEAST_POINTS

Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""Rotations (P, 3, 3) and positions (P, 3) of the platform in the base frame for a time offset, s."""

_TIME_STEP_S = 1e-4
_SMALLEST_SHARE = 1e-3
"""Of the points' noise; smaller scatter of the poses does not show."""
_LEAST_SHARE = 1e-3
"""Of the noise that the distances from a plane have: it leans by less than 0.06 deg from the sheet."""


@dataclass(frozen=True, eq=False)
class MountState:
    """Values of all unknowns: mount, artefact (as its `Shape` says), scale and offset."""

    rotation: np.ndarray
    translation: np.ndarray
    artefact: np.ndarray
    scale: float = 1.0
    offset_s: float = 0.0


@dataclass(frozen=True)
class Scatter:
    """Standard deviations: of a point, of each coordinate of a pose, and of its turn (rad; flat artefacts only)."""

    point_mm: float
    pose_mm: float
    turn_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Problem:
    """Points (n, 3) of every pose in the sensor's frame, mm, and which unknowns there are.

    The parameters are steps from a `MountState`: translation (3), rotation about the platform's axes (3), those of the
    artefact, then scale and offset. ``part`` says of each point (n,) on which surface of the artefact it lies.
    """

    points: Sequence[np.ndarray]
    motion: Motion
    across: np.ndarray
    """Normal (3,) of the sheet in the sensor's frame: points have no noise along it."""
    shape: Shape
    part: Sequence[np.ndarray]
    scale: bool = False
    time: bool = False
    table: bool = False
    """Whether the platform turns about its own z axis only, as a rotary table: shift along it and turn about it change
    nothing, and are no parameters."""

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
    def size(self) -> int:
        """Number of parameters."""
        return self.free.shape[1]

    @cached_property
    def free(self) -> np.ndarray:
        """Steps (K, size) of all K values by the parameters."""
        every = np.eye(6 + self.shape.count + self.scale + self.time)
        return np.delete(every, (2, 5), axis=1) if self.table else every

    @cached_property
    def _parts(self) -> np.ndarray:
        return np.concatenate(self.part)

    def of_all(self, covariance: np.ndarray) -> np.ndarray:
        """Covariance (K, K) of all values from that of the parameters: 0 for what is none."""
        return self.free @ covariance @ self.free.T

    @cached_property
    def numbers(self) -> int:
        """How many numbers all profiles determine together: three for a circle, two for a line."""
        return sum(self.shape.numbers(part) for part in self.part)

    def selected(
        self, kept: np.ndarray, points: Sequence[np.ndarray] | None = None, part: Sequence[np.ndarray] | None = None
    ) -> "Problem":
        """The problem of some of the poses (a mask), perhaps with other points of all poses."""
        motion, numbers = self.motion, np.flatnonzero(kept)
        given, parts = points or self.points, part or self.part
        return replace(
            self,
            points=[given[number] for number in numbers.tolist()],
            part=[parts[number] for number in numbers.tolist()],
            motion=lambda offset: tuple(each[numbers] for each in motion(offset)),
        )

    def of_seen(self, seen: Sequence[Seen | None]) -> "Problem":
        """The problem of the points of the artefact, as seen in all poses or (None) not."""
        pairs = [(n, each) for n, each in enumerate(seen) if each is not None]
        points, part = list(self.points), list(self.part)
        for number, each in pairs:
            points[number], part[number] = self.points[number][each.members], each.part[each.members]
        return self.selected(np.array([each is not None for each in seen]), points, part)

    def seen_again(
        self, state: MountState, flat: Sequence[np.ndarray], reach_mm: float, rng: np.random.Generator
    ) -> list[Seen | None]:
        """The artefact near where a state has it, in the profiles (N, 2) of all poses, or None."""
        off = np.split(self.shape.off(state.artefact, self.base(state)), np.cumsum(self.counts)[:-1])
        again = [self.shape.find_again(each, own, reach_mm, rng) for each, own in zip(flat, off, strict=True)]
        return [each if each is not None and each.members.sum() >= LEAST_POINTS else None for each in again]

    def thinned(self, most: int) -> "Problem":
        """The problem with at most so many points of each pose, evenly chosen."""
        rows = [np.unique(np.linspace(0, len(each) - 1, most).astype(int)) for each in self.points]
        points, part = (
            [each[own] for each, own in zip(given, rows, strict=True)] for given in (self.points, self.part)
        )
        return replace(self, points=points, part=part)

    def stepped(self, state: MountState, step: np.ndarray) -> MountState:
        """The state after a step of the parameters."""
        step = self.free @ step
        turned = Rotation.from_rotvec(step[3:6]).as_matrix() @ state.rotation
        used = 6 + self.shape.count
        artefact = self.shape.stepped(state.artefact, step[6:used])
        return MountState(
            turned,
            state.translation + step[:3],
            artefact,
            state.scale + (step[used] if self.scale else 0.0),
            state.offset_s + (step[used + self.scale] if self.time else 0.0),
        )

    def distances(self, state: MountState, step: np.ndarray | None = None) -> np.ndarray:
        """Signed distances (N,) of all points from the artefact, mm, after a step from a state."""
        state = state if step is None else self.stepped(state, step)
        return self.shape.distances(state.artefact, self.base(state), self._parts)

    def base(self, state: MountState) -> np.ndarray:
        """All points (N, 3) in the base frame, mm."""
        rotations, positions = self.motion(state.offset_s)
        platform = self._all @ state.rotation.T + state.translation
        return np.einsum("nij,nj->ni", rotations[self.poses], platform) + state.scale * positions[self.poses]

    def errors(self, state: MountState) -> np.ndarray:
        """Derivatives (N, K) of the distances by the error of their pose.

        A pose errs by a shift in three directions of the base, and by a turn about the middle of its profile where the
        artefact is flat. (A turn that a sphere sees is a shift of its centre.)
        """
        normals = self._normals(self.base(state), state)
        if not self.shape.flat:
            return normals
        middles = np.repeat([own.mean(axis=0) for own in self.points], self.counts, axis=0)
        arms = np.einsum("nij,nj->ni", self.motion(state.offset_s)[0][self.poses] @ state.rotation, self._all - middles)
        return self.on_lines(np.hstack([normals, np.cross(arms, normals)]))

    def derivatives(self, state: MountState) -> np.ndarray:
        """Derivatives (N, size) of the distances at a state by the parameters."""
        return self._derivatives(state) @ self.free

    def normals(self, state: MountState) -> np.ndarray:
        """Derivatives (N, 3) of the distances by the points, along the axes of the sensor."""
        rotations = self.motion(state.offset_s)[0]
        return np.einsum("nij,ni->nj", rotations[self.poses], self._normals(self.base(state), state)) @ state.rotation

    def _normals(self, base: np.ndarray, state: MountState) -> np.ndarray:
        """Normals (N, 3) of the artefact at points of the base frame."""
        return self.shape.normals(state.artefact, base, self._parts)

    def _derivatives(self, state: MountState) -> np.ndarray:
        """Derivatives (N, K) by all values."""
        rotations, positions = self.motion(state.offset_s)
        turned, base = self._all @ state.rotation.T, self.base(state)
        normals = self._normals(base, state)
        in_platform = np.einsum("nij,ni->nj", rotations[self.poses], normals)
        columns = [in_platform, np.cross(turned, in_platform)]
        columns.append(self.shape.derivatives(state.artefact, base, self._parts))
        if self.scale:
            columns.append(np.sum(normals * positions[self.poses], axis=1, keepdims=True))
        if self.time:
            later, earlier = (
                self.base(replace(state, offset_s=state.offset_s + s)) for s in (_TIME_STEP_S, -_TIME_STEP_S)
            )
            columns.append(np.sum(normals * (later - earlier), axis=1, keepdims=True) / (2 * _TIME_STEP_S))
        return self.on_lines(np.hstack(columns))

    @cached_property
    def _along(self) -> np.ndarray:
        """Positions (N,) along the parallel lines of each profile, or its wall, from its middle, mm."""
        along = []
        for own, part in zip(self.points, self.part, strict=True):
            result = np.zeros(len(own))
            for rows in self.shape.parallel(part):
                lines = [own[rows & (part == face)] for face in np.unique(part[rows])]
                centred = np.vstack([line - line.mean(axis=0) for line in lines])
                direction = np.linalg.svd(centred, full_matrices=False)[2][0]
                result[rows] = (own[rows] - own[rows].mean(axis=0)) @ direction
            along.append(result)
        return np.concatenate(along)

    @cached_property
    def _lines(self) -> list[np.ndarray]:
        """Orthonormal bases (n, K) of what can change in each profile besides noise."""
        along = np.split(self._along, np.cumsum(self.counts)[:-1])
        return [np.linalg.qr(self.shape.lines(own, part))[0] for own, part in zip(along, self.part, strict=True)]

    def on_lines(self, values: np.ndarray) -> np.ndarray:
        """Values (N, ...) beside a flat artefact as those of the lines of the profiles; others as they are.

        With the points' own noise in them, a plane far from the true one would seem to explain this noise.
        """
        if not self.shape.flat:
            return values
        ends = np.cumsum(self.counts)[:-1]
        parts = zip(self._lines, np.split(values, ends), strict=True)
        return np.concatenate([basis @ (basis.T @ own) for basis, own in parts])

    def noise_along(self, state: MountState) -> np.ndarray:
        """Share (N, 1) of the points' noise, which stays in the sheet, that their distances have.

        A plane that leans against the sheet shows less of it. If this were left out, a plane along the sheet would fit
        points without any noise. Spheres are cut near their middle.
        """
        if not self.shape.flat:
            return np.ones((len(self.poses), 1))
        out_of_sheet = self.normals(state) @ self.across
        return np.sqrt(np.maximum(1 - out_of_sheet**2, _LEAST_SHARE**2))[:, None]

    def whitening(self, state: MountState, scatter: Scatter) -> Callable[[np.ndarray], np.ndarray]:
        """Function that gives distances (N,) or their derivatives (N, ...) near a state the unit covariance."""
        share = self.noise_along(state)
        errors = self.errors(state) / share
        sizes = sizes_of(errors.shape[1], scatter)
        parts = []
        for own in np.split(np.arange(len(errors)), np.cumsum(self.counts)[:-1]):
            basis, upper = np.linalg.qr(errors[own] * sizes)
            values, vectors = np.linalg.eigh(upper @ upper.T)
            shrink = 1 - scatter.point_mm / np.sqrt(scatter.point_mm**2 + np.maximum(values, 0))
            parts.append((own, basis @ vectors, shrink))

        def whitened(values: np.ndarray) -> np.ndarray:
            result = values / (scatter.point_mm * (share if values.ndim > 1 else share[:, 0]))
            for own, basis, shrink in parts:
                result[own] -= (basis * shrink) @ (basis.T @ result[own])
            return result

        return whitened

    def solved(self, state: MountState, scatter: Scatter, *, loss: str = "linear") -> MountState:
        """The state of least weighted squares of the distances."""
        whitened = self.whitening(state, scatter)

        def jacobian(step: np.ndarray) -> np.ndarray:
            derivatives = self._derivatives(self.stepped(state, step))
            derivatives[:, 3:6] = derivatives[:, 3:6] @ _left_jacobian((self.free @ step)[3:6])
            return whitened(derivatives @ self.free)

        def misfit(step: np.ndarray) -> np.ndarray:
            return whitened(self.on_lines(self.distances(state, step)))

        found = least_squares(
            misfit,
            np.zeros(self.size),
            jacobian,  # pyright: ignore[reportArgumentType]
            loss=loss,
            x_scale="jac",
            max_nfev=60,
        )
        return self.stepped(state, found.x)

    def information(self, state: MountState, scatter: Scatter) -> np.ndarray:
        """Information (P, size, size) that the profile of each pose holds on the parameters."""
        weighted = np.split(self.whitening(state, scatter)(self.derivatives(state)), np.cumsum(self.counts)[:-1])
        return np.array([each.T @ each for each in weighted])

    def scatter_at(self, state: MountState, start: Scatter) -> Scatter:
        """Scatter of points and poses by restricted maximum likelihood at a solution.

        Patterson and Thompson 1971: minus twice the likelihood of what is left of the distances after the parameters.
        """
        share = self.noise_along(state)
        errors = self.errors(state) / share
        # Any basis of the derivatives has the same likelihood. They are nearly dependent where the base is far away.
        derivatives = np.linalg.qr(self.derivatives(state) / share)[0]
        k, size = errors.shape[1], derivatives.shape[1]
        columns = np.hstack([errors, derivatives, self.distances(state)[:, None] / share])
        grams = np.array([each.T @ each for each in np.split(columns, np.cumsum(self.counts)[:-1])])
        total, poses = int(self.counts.sum()), len(self.counts)

        def scatter_of(logs: np.ndarray) -> Scatter:
            point, *others = np.exp(np.clip(logs, -20, 5))
            return Scatter(
                point, *(max(each, _SMALLEST_SHARE * point * unit) for each, unit in zip(others, units, strict=True))
            )

        units = [1.0, 1e-3] if self.shape.flat else [1.0]

        def minus_twice_likelihood(logs: np.ndarray) -> float:
            scatter = scatter_of(logs)
            sizes, variance = sizes_of(k, scatter), scatter.point_mm**2
            inner = np.eye(k) * variance + sizes[:, None] * grams[:, :k, :k] * sizes
            cross = sizes[:, None] * grams[:, :k, k:]
            left = (grams[:, k:, k:] - np.swapaxes(cross, 1, 2) @ np.linalg.solve(inner, cross)).sum(axis=0) / variance
            information = left[:size, :size]
            squares = left[size, size] - left[size, :size] @ np.linalg.solve(information, left[:size, size])
            weights = (total - poses * k) * np.log(variance) + np.linalg.slogdet(inner)[1].sum()
            return float(weights + np.linalg.slogdet(information)[1] + squares)

        begin = np.log([start.point_mm, start.pose_mm, *([start.turn_rad] if self.shape.flat else [])])
        found = minimize(
            minus_twice_likelihood, begin, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3, "maxiter": 300}
        )
        return scatter_of(found.x)


def sizes_of(k: int, scatter: Scatter) -> np.ndarray:
    """Standard deviations (K,) of the errors of a pose: three shifts, and three turns of a flat artefact."""
    return np.repeat([scatter.pose_mm, scatter.turn_rad], 3)[:k]


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Derivative of exp(v + dv) exp(-v) by dv as a rotation vector (J. Sola and others 2018, arXiv:1812.01537, 145)."""
    angle, cross = float(np.linalg.norm(vector)), cross_matrix(vector)
    if angle < 1e-6:
        return np.eye(3) + cross / 2
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross
