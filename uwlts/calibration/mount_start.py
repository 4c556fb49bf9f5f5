"""Start values of a mount: in closed form from circles of a sphere, or by search from lines of a plane or step."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.calibration.mount_model import MountState, Problem, Scatter
from uwlts.calibration.mount_profiles import ProfileArc, ProfileLine

_SUBSETS, _SUBSET = 40, 8
"""Random choices of poses: with a fifth of the poses wrong one of six choices of eight has none of these."""
_TRIED = 4
_THINNED = 9
_TURNS, _TURNS_TRIED = 5000, 10
"""Rotations tried for a plane, some 12 deg apart, and how many of the best are refined."""
_RADII = (1.02, 1.15, 1.5)
"""Radius of an unknown sphere over that of its largest section."""
_REWEIGHTED = 10
_ROUGH = Scatter(point_mm=0.1, pose_mm=0.3, turn_rad=3e-3)
"""Scatter for the weights of the search, whose robust loss begins beyond it."""


def start_of_sphere(
    problem: Problem, arcs: list[ProfileArc], sheet: np.ndarray, rng: np.random.Generator
) -> MountState:
    """State near the solution from the arcs found in the profiles; ``sheet`` (4, 4) maps the sheet's frame to the
    sensor's.

    Without its part across the sheet, y = +-sqrt(R2 - r2), the centre of a circle of radius r in the profile is the
    sphere's centre in the sensor's frame, and R s + t = A^T (c - a) is linear in R's columns, t and c for poses (A, a).
    The side of the sheet on which the centre lies follows from the solution; both sides are tried where it does not.
    """
    rotations, positions = problem.motion(0.0)
    centres, radii = np.array([arc.centre_mm for arc in arcs]), np.array([arc.radius_mm for arc in arcs])
    everything = np.arange(len(arcs))
    subsets = [everything]
    if len(arcs) > _SUBSET:
        subsets += [rng.choice(everything, _SUBSET, replace=False) for _ in range(_SUBSETS)]
    found: list[tuple[float, MountState]] = []
    largest = float(np.quantile(radii, 0.9))
    for radius in [problem.radius_mm] if problem.radius_mm else [share * largest for share in _RADII]:
        depth = np.sqrt(np.maximum(radius**2 - radii**2, 0))
        for subset in subsets:
            for state in _linear_solutions(rotations, positions, centres, depth, subset, radius):
                found.append((_misfit(rotations, positions, centres, depth, state), state))
    found.sort(key=lambda each: each[0])
    rough = problem.thinned(_THINNED)
    return _best(rough, [_in_sensor_frame(state, sheet) for _, state in found[:_TRIED]])


def start_on_table(problem: Problem, arcs: list[ProfileArc], sheet: np.ndarray, towards: np.ndarray) -> MountState:
    """State near the solution from the arcs of a sphere on a rotary table; ``sheet`` as in `start_of_sphere`.

    At angle h the sphere's centre is q + a cos h + b sin h in the sensor's frame, linear in the six coordinates in the
    sheet. As a and b have the same length and are square to each other, their parts across it are the complex root
    a_y + i b_y = +-sqrt(|b|^2 - |a|^2 - 2 i a.b), with both lengths and the product those in the sheet. The two
    solutions mirror each other in the sheet and fit profiles alike: that one is taken whose axis, about which the
    sphere turns by the angles, points along ``towards`` (3,) of the sensor's frame.
    """
    rotations, positions = problem.motion(0.0)
    angles = -Rotation.from_matrix(rotations[0].T @ rotations).as_rotvec()[:, 2]
    centres, radii = np.array([arc.centre_mm for arc in arcs]), np.array([arc.radius_mm for arc in arcs])
    design = np.column_stack([np.ones(len(arcs)), np.cos(angles), np.sin(angles)])
    weights, flat = np.ones(len(arcs)), np.zeros((3, 2))
    for _ in range(_REWEIGHTED):
        flat = np.linalg.lstsq(design * weights[:, None], centres * weights[:, None], rcond=None)[0]
        off = np.linalg.norm(centres - design @ flat, axis=1)
        # Cauchy's weights.
        weights = 1 / np.sqrt(1 + (off / max(2 * float(np.median(off)), 1e-6)) ** 2)
    largest, states = float(np.quantile(radii, 0.9)), []
    root = np.sqrt(complex(flat[2] @ flat[2] - flat[1] @ flat[1], -2 * flat[1] @ flat[2]))
    for radius in [problem.radius_mm] if problem.radius_mm else [share * largest for share in _RADII]:
        depth = np.sqrt(np.maximum(radius**2 - radii**2, 0))
        for across in (root, -root):
            moving = np.cos(angles) * across.real + np.sin(angles) * across.imag
            tried = np.concatenate([depth - moving, -depth - moving])
            middle = tried[np.argmin(np.median(np.abs(np.abs(tried[:, None] + moving) - depth), axis=1))]
            q, a, b = (np.array([u, y, w]) for (u, w), y in zip(flat, (middle, across.real, across.imag), strict=True))
            axis = np.cross(a, b)
            if axis @ (sheet[:3, :3].T @ towards) <= 0:
                continue
            turn = Rotation.align_vectors([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [a, b, axis / np.linalg.norm(a)])[0]
            rotation = turn.as_matrix()
            height, reach = float(rotation[2] @ q), float(np.sqrt(np.linalg.norm(axis)))
            translation = np.array([0.0, 0.0, height]) - rotation @ q
            place = rotations[0] @ np.array([reach, 0.0, height]) + positions[0]
            states.append(MountState(rotation, translation, np.append(place, radius)))
    return _best(problem.thinned(_THINNED), [_in_sensor_frame(state, sheet) for state in states])


def _linear_solutions(
    rotations: np.ndarray,
    positions: np.ndarray,
    centres: np.ndarray,
    depth: np.ndarray,
    subset: np.ndarray,
    radius: float,
) -> list[MountState]:
    back, shift = np.swapaxes(rotations, 1, 2)[subset], _turned_back(rotations, -positions)[subset]
    states, one = [], np.broadcast_to(np.eye(3), back.shape)
    for side in (0.0, 1.0, -1.0):
        sides = np.full(len(subset), side)
        across = np.zeros(3)
        rotation, translation, centre = np.eye(3), np.zeros(3), np.zeros(3)
        for _ in range(3):
            u, w = centres[subset].T
            known = shift - (sides * depth[subset])[:, None] * across
            design = np.concatenate([u[:, None, None] * one, w[:, None, None] * one, one, -back], axis=2)
            solution = np.linalg.lstsq(design.reshape(-1, 12), known.ravel(), rcond=1e-10)[0]
            left, _, right = np.linalg.svd(solution[:6].reshape(2, 3).T, full_matrices=False)
            first, third = (left @ right).T
            across = np.cross(third, first)
            rotation = np.column_stack([first, across, third])
            places = np.column_stack([u, sides * depth[subset], w]) @ rotation.T
            both = np.linalg.lstsq(
                np.concatenate([one, -back], axis=2).reshape(-1, 6), (shift - places).ravel(), rcond=1e-10
            )[0]
            translation, centre = both[:3], both[3:]
            if side == 0.0:
                sides = np.sign((_turned_back(rotations, centre - positions)[subset] - translation) @ across)
        states.append(MountState(rotation, translation, np.append(centre, radius)))
    return states


def _turned_back(rotations: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (P, 3) of the base frame along the axes of the platform."""
    return np.einsum("pji,pj->pi", rotations, vectors)


def _misfit(
    rotations: np.ndarray, positions: np.ndarray, centres: np.ndarray, depth: np.ndarray, state: MountState
) -> float:
    """Median over the poses of the distance between the centre of the sphere and where the profile says it is."""
    seen = (_turned_back(rotations, state.artefact[:3] - positions) - state.translation) @ state.rotation
    off = np.hypot(*(seen[:, [0, 2]] - centres).T)
    return float(np.median(np.hypot(off, np.abs(seen[:, 1]) - depth)))


def _in_sensor_frame(state: MountState, sheet: np.ndarray) -> MountState:
    """The state of a sheet's frame as one of the sensor's."""
    rotation = state.rotation @ sheet[:3, :3].T
    return MountState(rotation, state.translation - rotation @ sheet[:3, 3], state.artefact)


def start_of_plane(
    problem: Problem, lines: list[ProfileLine], sheet: np.ndarray, rng: np.random.Generator
) -> MountState:
    """State near the solution from the lines found in the profiles; ``sheet`` as in `start_of_sphere`.

    The lines' directions in the base are square to the plane's normal whatever the translation: of many rotations the
    best are kept by the smallest eigenvalue of the directions' scatter, whose vector is the normal. Translation and
    distance are linear then.
    """
    rotations, positions = problem.motion(0.0)
    middles = _in_space(np.array([line.middle_mm for line in lines]))
    directions = _in_space(np.array([line.direction for line in lines]))
    turns = Rotation.random(_TURNS, rng=rng).as_matrix()
    seen = np.einsum("pij,tjk,pk->tpi", rotations, turns, directions)
    values, vectors = np.linalg.eigh(np.einsum("tpi,tpj->tij", seen, seen))
    states = []
    for number in np.argsort(values[:, 0])[:_TURNS_TRIED]:
        normal = vectors[number, :, 0]
        # Half a turn about the sheet's normal leaves the directions as they are.
        for turn in (turns[number], turns[number] * np.array([-1.0, 1.0, -1.0])):
            places = np.einsum("pij,jk,pk->pi", rotations, turn, middles) + positions
            design = np.column_stack([np.einsum("pji,j->pi", rotations, normal), -np.ones(len(lines))])
            solution = np.linalg.lstsq(design, -places @ normal, rcond=1e-10)[0]
            states.append(MountState(turn, solution[:3], np.append(normal, solution[3])))
    return _best(problem.thinned(_THINNED), [_in_sensor_frame(state, sheet) for state in states])


def start_of_step(
    problem: Problem, lines: list[ProfileLine], sheet: np.ndarray, rng: np.random.Generator
) -> MountState:
    """State near the solution from the lines of both faces of a step: as of a plane from the first, then the height."""
    assert problem.second is not None
    first = [points[np.logical_not(own)] for points, own in zip(problem.points, problem.second, strict=True)]
    state = start_of_plane(replace(problem, points=first, second=None), lines, sheet, rng)
    state = replace(state, artefact=np.append(state.artefact, 0.0))
    found = float(np.median(problem.distances(state)[np.concatenate(problem.second)]))
    height = found if problem.height_mm is None else float(np.copysign(problem.height_mm, found))
    return replace(state, artefact=np.append(state.artefact[:4], height))


def _in_space(flat: np.ndarray) -> np.ndarray:
    """Points or directions (P, 2) of the sheet in its frame (P, 3)."""
    return np.column_stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]])


def _best(rough: Problem, states: list[MountState]) -> MountState:
    """The state of smallest median distance after a robust refinement from each, scale and time left as they are."""
    fixed = replace(rough, scale=False, time=False)
    refined = [fixed.solved(state, _ROUGH, loss="cauchy") for state in states]
    return min(refined, key=lambda state: float(np.median(misfits(fixed, state))))


def misfits(problem: Problem, state: MountState) -> np.ndarray:
    """Root mean square distance (P,) of the points of each pose."""
    squares = problem.distances(state) ** 2
    return np.sqrt(np.bincount(problem.poses, squares) / problem.counts)
