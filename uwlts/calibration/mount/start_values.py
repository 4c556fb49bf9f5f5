"""Start values of a mount: closed form from circles of a sphere, or search from lines of a plane."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.calibration.mount.profile_evidence import MountState, Problem, Scatter, from_sheet, thin
from uwlts.errors import CalibrationError
from uwlts.shapes.profile_curves import Detection, ProfileArc, ProfileLine

_SUBSET = 8  # poses of a random subset: 24 linear equations for 12 unknowns
_SUBSETS = 40  # random subsets: with a fifth of the poses wrong, one of six subsets contains no wrong pose
_TRIED = 4  # best linear solutions for a sphere, which are refined
_THINNED = 9  # points of each profile in the refinement of start values
_TURNS = 5000  # rotations tried for a plane, some 12 deg apart
_TURNS_TRIED = 10  # best rotations, which are refined
_RADII = (1.02, 1.15, 1.5)  # trial radii of an unknown sphere, relative to its largest section
_REWEIGHTED = 10  # rounds of Cauchy weights; a start needs no more digits
_ROUGH = Scatter(point_mm=0.1, smooth_mm=1e-4, length_mm=1.0, pose_mm=0.3, turn_rad=3e-3)
"""Scatter for the weights of the search; beyond it the loss is robust."""


class NoFit(CalibrationError):
    """Profiles, poses and the known size of the artefact contradict each other."""


def start(
    problem: Problem, seen: Sequence[Detection], sheet: np.ndarray, towards: np.ndarray | None, rng: np.random.Generator
) -> MountState:
    """Estimate a state near the solution.

    ``sheet`` (4, 4) maps the sheet's frame to the sensor's. ``towards`` (3,) is the direction of the sensor's frame
    nearest to the axis of a rotary table.
    """
    arcs = [each for each in seen if isinstance(each, ProfileArc)]
    if problem.shape.flat:
        return _start_of_plane(problem, [each for each in seen if isinstance(each, ProfileLine)], sheet, rng)
    return (
        _start_sphere(problem, arcs, sheet, rng) if towards is None else _start_on_table(problem, arcs, sheet, towards)
    )


def _start_sphere(problem: Problem, arcs: list[ProfileArc], sheet: np.ndarray, rng: np.random.Generator) -> MountState:
    """Estimate a state near the solution from the arcs in the profiles; ``sheet`` as in `start`.

    The centre of a circle of radius r in a profile is the sphere's centre without its coordinate across the sheet, y =
    +-sqrt(R2 - r2). R s + t = A^T (c - a) is linear in R's columns, t and c for poses (A, a). The sign of y follows
    from the solution, and both signs are tried otherwise.
    """
    rotations, positions = problem.motion(0.0)
    centres, radii = np.array([arc.centre_mm for arc in arcs]), np.array([arc.radius_mm for arc in arcs])
    everything = np.arange(len(arcs))
    subsets = [everything]
    if len(arcs) > _SUBSET:
        subsets += [rng.choice(everything, _SUBSET, replace=False) for _ in range(_SUBSETS)]
    found: list[tuple[float, MountState]] = []
    largest = float(np.quantile(radii, 0.9))
    for radius in [problem.shape.radius_mm] if problem.shape.radius_mm else [share * largest for share in _RADII]:
        depth = np.sqrt(np.maximum(radius**2 - radii**2, 0))
        for subset in subsets:
            for state in _solve_linearly(rotations, positions, centres, depth, subset, radius):
                found.append((_compute_misfit(rotations, positions, centres, depth, state), state))
    found.sort(key=lambda each: each[0])
    return _refine_best(problem, [state for _, state in found[:_TRIED]], sheet)


def _start_on_table(problem: Problem, arcs: list[ProfileArc], sheet: np.ndarray, towards: np.ndarray) -> MountState:
    """Estimate a state near the solution from the arcs of a sphere on a rotary table; ``sheet`` as in `start`.

    At angle h the sphere's centre is q + a cos h + b sin h in the sensor's frame, linear in the six coordinates in the
    sheet. Vectors a and b have the same length and are perpendicular. Their coordinates across the sheet are therefore
    the complex root a_y + i b_y = +-sqrt(|b|^2 - |a|^2 - 2 i a.b), with lengths and product in the sheet. The two
    solutions are mirror images and fit the profiles equally well. The solution is used whose axis, about which the
    sphere turns by the angles, points along ``towards`` (3,) of the sensor's frame.
    """
    rotations, positions = problem.motion(0.0)
    angles = -Rotation.from_matrix(rotations[0].T @ rotations).as_rotvec()[:, 2]
    centres, radii = np.array([arc.centre_mm for arc in arcs]), np.array([arc.radius_mm for arc in arcs])
    flat = _solve_robustly(np.column_stack([np.ones(len(arcs)), np.cos(angles), np.sin(angles)]), centres)
    largest, states = float(np.quantile(radii, 0.9)), []
    root = np.sqrt(complex(flat[2] @ flat[2] - flat[1] @ flat[1], -2 * flat[1] @ flat[2]))
    for radius in [problem.shape.radius_mm] if problem.shape.radius_mm else [share * largest for share in _RADII]:
        depth = np.sqrt(np.maximum(radius**2 - radii**2, 0))
        for other in (root, -root):
            moving = np.cos(angles) * other.real + np.sin(angles) * other.imag
            tried = np.concatenate([depth - moving, -depth - moving])
            middle = tried[np.argmin(np.median(np.abs(np.abs(tried[:, None] + moving) - depth), axis=1))]
            q, a, b = (np.array([u, y, w]) for (u, w), y in zip(flat, (middle, other.real, other.imag), strict=True))
            axis = np.cross(a, b)
            if axis @ (sheet[:3, :3].T @ towards) <= 0:
                continue
            turn = Rotation.align_vectors([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [a, b, axis / np.linalg.norm(a)])[0]
            rotation = turn.as_matrix()
            height, reach = float(rotation[2] @ q), float(np.sqrt(np.linalg.norm(axis)))
            translation = np.array([0.0, 0.0, height]) - rotation @ q
            place = rotations[0] @ np.array([reach, 0.0, height]) + positions[0]
            states.append(MountState(rotation, translation, np.append(place, radius)))
    return _refine_best(problem, states, sheet)


def _solve_linearly(
    rotations: np.ndarray,
    positions: np.ndarray,
    centres: np.ndarray,
    depth: np.ndarray,
    subset: np.ndarray,
    radius: float,
) -> list[MountState]:
    back, shift = np.swapaxes(rotations, 1, 2)[subset], _rotate_back(rotations, -positions)[subset]
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
                sides = np.sign((_rotate_back(rotations, centre - positions)[subset] - translation) @ across)
        states.append(MountState(rotation, translation, np.append(centre, radius)))
    return states


def _rotate_back(rotations: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors (P, 3) of the base frame into the axes of the platform."""
    return np.einsum("pji,pj->pi", rotations, vectors)


def _compute_misfit(
    rotations: np.ndarray, positions: np.ndarray, centres: np.ndarray, depth: np.ndarray, state: MountState
) -> float:
    """Return the median distance over the poses between the sphere's centre and its position from the profile."""
    seen = (_rotate_back(rotations, state.artefact[:3] - positions) - state.translation) @ state.rotation
    off = np.hypot(*(seen[:, [0, 2]] - centres).T)
    return float(np.median(np.hypot(off, np.abs(seen[:, 1]) - depth)))


def _start_of_plane(
    problem: Problem, lines: list[ProfileLine], sheet: np.ndarray, rng: np.random.Generator
) -> MountState:
    """Estimate a state near the solution from the lines in the profiles; ``sheet`` as in `start`.

    The lines' directions in the base are perpendicular to the plane's normal for any translation. Random rotations are
    ranked by the smallest eigenvalue of the directions' scatter, whose eigenvector is the normal. Translation and
    distance are then linear.
    """
    rotations, positions = problem.motion(0.0)
    middles = from_sheet(np.array([line.middle_mm for line in lines]))
    directions = from_sheet(np.array([line.direction for line in lines]))
    turns = Rotation.random(_TURNS, rng=rng).as_matrix()
    seen = np.einsum("pij,tjk,pk->tpi", rotations, turns, directions)
    values, vectors = np.linalg.eigh(np.einsum("tpi,tpj->tij", seen, seen))
    states = []
    for number in np.argsort(values[:, 0])[:_TURNS_TRIED]:
        normal = vectors[number, :, 0]
        # half a turn about the sheet's normal does not change the directions
        for turn in (turns[number], turns[number] * np.array([-1.0, 1.0, -1.0])):
            places = np.einsum("pij,jk,pk->pi", rotations, turn, middles) + positions
            design = np.column_stack([np.einsum("pji,j->pi", rotations, normal), -np.ones(len(lines))])
            solution = _solve_robustly(design, -(places @ normal)[:, None])[:, 0]
            states.append(MountState(turn, solution[:3], np.append(normal, solution[3])))
    return _refine_best(problem, states, sheet)


def _solve_robustly(design: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Solve linear equations, ``design`` (N, k) and ``wanted`` (N, m), robustly with Cauchy weights; return (k, m)."""
    weights, solution = np.ones(len(design)), np.zeros((design.shape[1], wanted.shape[1]))
    for _ in range(_REWEIGHTED):
        solution = np.linalg.lstsq(design * weights[:, None], wanted * weights[:, None], rcond=1e-10)[0]
        off = np.linalg.norm(design @ solution - wanted, axis=1)
        weights = 1 / np.sqrt(1 + (off / max(2 * float(np.median(off)), 1e-6)) ** 2)
    return solution


def _refine_best(problem: Problem, states: list[MountState], sheet: np.ndarray) -> MountState:
    """Refine states of the sheet's frame robustly; return the best by the median distance, in the sensor's frame.

    Scale and time offset are not refined.
    """
    fixed = replace(problem, points=[thin(each, _THINNED) for each in problem.points], scale=False, time=False)
    turns = [state.rotation @ sheet[:3, :3].T for state in states]
    moved = [
        replace(state, rotation=turn, translation=state.translation - turn @ sheet[:3, 3])
        for state, turn in zip(states, turns, strict=True)
    ]
    refined = [fixed.solve(state, _ROUGH) for state in moved]
    return min(refined, key=lambda state: float(np.median(fixed.rms_mm(state))))
