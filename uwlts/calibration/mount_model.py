"""Model of a profiler on a platform before a fixed sphere, plane or step: distances, derivatives and weights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""Rotations (P, 3, 3) and positions (P, 3) of the platform in the base frame for a time offset, s."""

_TIME_STEP_S = 1e-4
_SMALLEST_SHARE = 1e-3
"""Of the points' noise; smaller scatter of the poses does not show."""
_LEAST_SHARE = 1e-3
"""Of the noise that the distances from a plane have: it leans by less than 0.06 deg from the sheet."""


@dataclass(frozen=True, eq=False)
class MountState:
    """Values of all unknowns: mount, artefact, scale and offset.

    The artefact is a sphere's centre and radius (4,), a plane's normal and distance (4,), or a step's (5,): those of
    its face at smaller z of the profiles, and how far along the normal the other one lies.
    """

    rotation: np.ndarray
    translation: np.ndarray
    artefact: np.ndarray
    scale: float = 1.0
    offset_s: float = 0.0


@dataclass(frozen=True)
class Scatter:
    """Standard deviations: of a point, of each coordinate of a pose, and of its turn (planes only; rad)."""

    point_mm: float
    pose_mm: float
    turn_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Problem:
    """Points (n, 3) of every pose in the sensor's frame, mm, and which unknowns there are.

    The parameters are steps from a `MountState`: translation (3), rotation about the platform's axes (3), centre (3)
    and, if it is unknown, radius of a sphere, or two turns of the normal and the distance of a plane or of a step's
    first face and, if it is unknown, the height of the step, then scale and offset.
    """

    points: Sequence[np.ndarray]
    motion: Motion
    across: np.ndarray
    """Normal (3,) of the sheet in the sensor's frame: points have no noise along it."""
    sphere: bool
    radius_mm: float | None
    scale: bool = False
    time: bool = False
    table: bool = False
    """Whether the platform turns about its own z axis only, as a rotary table: shift along it and turn about it change
    nothing, and are no parameters."""
    second: Sequence[np.ndarray] | None = None
    """Of a step, which points (n,) of every pose lie on its second face; None for a plane."""
    height_mm: float | None = None

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
        every = np.eye(9 + self.size_unknown + self.scale + self.time)
        return np.delete(every, (2, 5), axis=1) if self.table else every

    @property
    def size_unknown(self) -> bool:
        """Whether the radius of the sphere, or the height of the step, is a parameter."""
        return self.radius_mm is None if self.sphere else self.second is not None and self.height_mm is None

    @cached_property
    def _level(self) -> np.ndarray:
        """1 for each of the points (N,) on the second face of a step, else 0."""
        return np.zeros(len(self._all)) if self.second is None else np.concatenate(self.second).astype(np.float64)

    def of_all(self, covariance: np.ndarray) -> np.ndarray:
        """Covariance (K, K) of all values from that of the parameters: 0 for what is none."""
        return self.free @ covariance @ self.free.T

    @property
    def per_pose(self) -> int:
        """Numbers that the profile of one pose determines: a circle's three, or a line's two."""
        return 3 if self.sphere else 2

    def selected(
        self, kept: np.ndarray, points: Sequence[np.ndarray] | None = None, second: Sequence[np.ndarray] | None = None
    ) -> "Problem":
        """The problem of some of the poses (a mask), perhaps with other points of all poses."""
        given, motion, numbers = points or self.points, self.motion, np.flatnonzero(kept)
        levels = second or self.second
        return replace(
            self,
            points=[given[number] for number in numbers.tolist()],
            second=None if levels is None else [levels[number] for number in numbers.tolist()],
            motion=lambda offset: tuple(each[numbers] for each in motion(offset)),
        )

    def thinned(self, most: int) -> "Problem":
        """The problem with at most so many points of each pose, evenly chosen."""
        rows = [np.unique(np.linspace(0, len(each) - 1, most).astype(int)) for each in self.points]
        points, second = (
            None if given is None else [each[own] for each, own in zip(given, rows, strict=True)]
            for given in (self.points, self.second)
        )
        return replace(self, points=points, second=second)

    def stepped(self, state: MountState, step: np.ndarray) -> MountState:
        """The state after a step of the parameters."""
        step = self.free @ step
        turned = Rotation.from_rotvec(step[3:6]).as_matrix() @ state.rotation
        if self.sphere:
            radius = state.artefact[3] + (step[9] if self.radius_mm is None else 0.0)
            artefact, used = np.append(state.artefact[:3] + step[6:9], radius), 9 + (self.radius_mm is None)
        else:
            normal = state.artefact[:3] + step[6:8] @ _across(state.artefact[:3])
            normal /= np.linalg.norm(normal)
            height = state.artefact[4:] + (step[9] if self.size_unknown else 0.0)
            artefact, used = np.concatenate([normal, [state.artefact[3] + step[8]], height]), 9 + self.size_unknown
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
        base = self._base(state)
        if self.sphere:
            return np.linalg.norm(base - state.artefact[:3], axis=1) - state.artefact[3]
        off = base @ state.artefact[:3] - state.artefact[3]
        return off if self.second is None else off - state.artefact[4] * self._level

    def _base(self, state: MountState) -> np.ndarray:
        rotations, positions = self.motion(state.offset_s)
        platform = self._all @ state.rotation.T + state.translation
        return np.einsum("nij,nj->ni", rotations[self.poses], platform) + state.scale * positions[self.poses]

    def errors(self, state: MountState) -> np.ndarray:
        """Derivatives (N, K) of the distances by the error of their pose.

        A pose errs by a shift in three directions of the base. Beside a plane it errs by a shift along the normal, and
        by a turn that inclines the line of the profile. (A turn that a sphere sees is a shift of its centre.)
        """
        base = self._base(state)
        if self.sphere:
            return self._normals(base, state)
        return np.column_stack([np.ones(len(base)), self._along])

    def derivatives(self, state: MountState) -> np.ndarray:
        """Derivatives (N, size) of the distances at a state by the parameters."""
        return self._derivatives(state) @ self.free

    def normals(self, state: MountState) -> np.ndarray:
        """Derivatives (N, 3) of the distances by the points, along the axes of the sensor."""
        rotations = self.motion(state.offset_s)[0]
        return np.einsum("nij,ni->nj", rotations[self.poses], self._normals(self._base(state), state)) @ state.rotation

    def _normals(self, base: np.ndarray, state: MountState) -> np.ndarray:
        """Normals (N, 3) of the artefact at points of the base frame, away from the sphere's centre."""
        if not self.sphere:
            return np.broadcast_to(state.artefact[:3], base.shape)
        away = base - state.artefact[:3]
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    def _derivatives(self, state: MountState) -> np.ndarray:
        """Derivatives (N, K) by all values."""
        rotations, positions = self.motion(state.offset_s)
        turned, base = self._all @ state.rotation.T, self._base(state)
        normals = self._normals(base, state)
        in_platform = np.einsum("nij,ni->nj", rotations[self.poses], normals)
        columns = [in_platform, np.cross(turned, in_platform)]
        if self.sphere:
            columns += [-normals, *([np.full((len(base), 1), -1.0)] if self.radius_mm is None else [])]
        else:
            columns += [base @ _across(state.artefact[:3]).T, np.full((len(base), 1), -1.0)]
            columns += [-self._level[:, None]] if self.size_unknown else []
        if self.scale:
            columns.append(np.sum(normals * positions[self.poses], axis=1, keepdims=True))
        if self.time:
            later, earlier = (
                self._base(replace(state, offset_s=state.offset_s + s)) for s in (_TIME_STEP_S, -_TIME_STEP_S)
            )
            columns.append(np.sum(normals * (later - earlier), axis=1, keepdims=True) / (2 * _TIME_STEP_S))
        derivatives = np.hstack(columns)
        if self.sphere:
            return derivatives
        return self.on_lines(derivatives)

    @cached_property
    def _along(self) -> np.ndarray:
        """Positions (N,) along the line, or the two parallel lines, of each profile from its middle, mm."""
        along = []
        for own, level in zip(self.points, np.split(self._level, np.cumsum(self.counts)[:-1]), strict=True):
            lines = [own[level == face] for face in (0, 1) if np.any(level == face)]
            centred = np.vstack([line - line.mean(axis=0) for line in lines])
            along.append((own - own.mean(axis=0)) @ np.linalg.svd(centred, full_matrices=False)[2][0])
        return np.concatenate(along)

    @cached_property
    def _lines(self) -> list[np.ndarray]:
        """Orthonormal bases (n, K) of what shift and turn of each profile's line, and a step, do to its distances."""
        faces = [] if self.second is None else [self._level]
        every = np.column_stack([np.ones(len(self._along)), self._along, *faces])
        return [np.linalg.qr(each)[0] for each in np.split(every, np.cumsum(self.counts)[:-1])]

    def on_lines(self, values: np.ndarray) -> np.ndarray:
        """Values (N, ...) beside a plane as those of the lines of the profiles.

        With the points' own noise in them, a plane far from the true one would seem to explain this noise.
        """
        ends = np.cumsum(self.counts)[:-1]
        parts = zip(self._lines, np.split(values, ends), strict=True)
        return np.concatenate([basis @ (basis.T @ own) for basis, own in parts])

    def noise_along(self, state: MountState) -> np.ndarray:
        """Share (N, 1) of the points' noise, which stays in the sheet, that their distances have.

        A plane that leans against the sheet shows less of it. If this were left out, a plane along the sheet would fit
        points without any noise. Spheres are cut near their middle.
        """
        if self.sphere:
            return np.ones((len(self.poses), 1))
        normals = self.motion(state.offset_s)[0] @ (state.rotation @ self.across)
        return np.sqrt(np.maximum(1 - (normals @ state.artefact[:3]) ** 2, _LEAST_SHARE**2))[self.poses, None]

    def whitening(self, state: MountState, scatter: Scatter) -> Callable[[np.ndarray], np.ndarray]:
        """Function that gives distances (N,) or their derivatives (N, ...) near a state the unit covariance."""
        share = self.noise_along(state)
        errors = self.errors(state) / share
        sizes = _sizes(errors.shape[1], scatter)
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
            off = self.distances(state, step)
            return whitened(off if self.sphere else self.on_lines(off))

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

        units = [1.0] if k == 3 else [1.0, 1e-3]

        def minus_twice_likelihood(logs: np.ndarray) -> float:
            scatter = scatter_of(logs)
            sizes, variance = _sizes(k, scatter), scatter.point_mm**2
            inner = np.eye(k) * variance + sizes[:, None] * grams[:, :k, :k] * sizes
            cross = sizes[:, None] * grams[:, :k, k:]
            left = (grams[:, k:, k:] - np.swapaxes(cross, 1, 2) @ np.linalg.solve(inner, cross)).sum(axis=0) / variance
            information = left[:size, :size]
            squares = left[size, size] - left[size, :size] @ np.linalg.solve(information, left[:size, size])
            weights = (total - poses * k) * np.log(variance) + np.linalg.slogdet(inner)[1].sum()
            return float(weights + np.linalg.slogdet(information)[1] + squares)

        begin = np.log([start.point_mm, start.pose_mm, *([start.turn_rad] if k == 2 else [])])
        found = minimize(
            minus_twice_likelihood, begin, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3, "maxiter": 300}
        )
        return scatter_of(found.x)


def _sizes(k: int, scatter: Scatter) -> np.ndarray:
    """Standard deviations (K,) of the errors of a pose."""
    return np.full(3, scatter.pose_mm) if k == 3 else np.array([scatter.pose_mm, scatter.turn_rad])


def _across(normal: np.ndarray) -> np.ndarray:
    """Unit directions (2, 3) square to a normal and to each other."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(normal, first)])


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
