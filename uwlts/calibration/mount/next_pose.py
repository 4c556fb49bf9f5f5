"""Weakly determined directions of a mount, missing motions, and the best pose to add."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.calibration.mount.profile_evidence import MountState, Problem, Scatter, SphereShape, to_sheet
from uwlts.calibration.mount.restricted_likelihood import RestrictedEstimate
from uwlts.errors import CalibrationError
from uwlts.fitting.next_observation import Candidate, CovarianceRoot, rank_candidates
from uwlts.model.calibration import rigid_transform
from uwlts.model.mount import NextPose
from uwlts.model.sensor import to_rows

_TURN_RAD = np.radians(30)  # rotation that a robot easily makes with the artefact in view
_LEAST_TURN_RAD = np.radians(5.0)  # RMS rotation about an axis below which a warning is given
_OPEN_MM = 5.0  # standard uncertainty of a shift that counts as not determined: a ruler is better
OPEN_RAD = np.radians(1.0)  # standard uncertainty of a rotation that counts as not determined: a protractor is better
_WEAK = 5.0  # ratio to the uncertainty of the best determined direction above which a further pose is advised
_LEAST_MM = 0.01  # standard uncertainty of a shift below which no further pose is advised
_LEAST_RAD = np.radians(0.005)  # the same for a rotation: 0.02 mm at 220 mm
_POINTS = 100  # points of a simulated profile; more points are redundant
_UNKNOWN_MM = 100.0  # prior standard uncertainty of the mount's shift, so that undetermined directions can be compared
_UNKNOWN_RAD = 0.5  # the same for its rotation


def next_pose(
    problem: Problem, state: MountState, scatter: Scatter, sheet: np.ndarray, names: list[str]
) -> NextPose | None:
    """Select the best additional pose: a rotation by 30 deg about a platform axis, and a place of the artefact.

    Each candidate is scored by the standard uncertainty of a point in the middle of all points. ``sheet`` (4, 4) maps
    the sheet's frame to the sensor's; ``names`` are those of the poses. None on a rotary table, or if the plane would
    be too steep in all candidates.
    """
    if problem.table:
        return None
    prior = np.zeros(problem.size)
    prior[:3], prior[3:6] = _UNKNOWN_MM**-2.0, _UNKNOWN_RAD**-2.0
    information = RestrictedEstimate(problem, state, np.array(scatter)).information.sum(axis=0)
    # Derivatives of the middle point, along the platform's axes, by shift and rotation of the mount.
    middle, to_point = state.rotation @ np.vstack(problem.points).mean(axis=0), np.eye(3, problem.size)
    to_point[:, 3:6] = np.cross(middle, np.eye(3))
    known = CovarianceRoot.from_information(information + np.diag(prior))
    ranked = rank_candidates(known, to_point, _generate_candidates(problem, state, scatter, sheet, names))
    if not ranked:
        return None
    best = ranked[0]
    return NextPose(
        words=best.candidate.words,
        T_base_platform=to_rows(best.candidate.pose),
        before_mm=best.before,
        after_mm=best.after,
    )


def _generate_candidates(
    problem: Problem, state: MountState, scatter: Scatter, sheet: np.ndarray, names: list[str]
) -> Iterator[Candidate]:
    """Generate rotations of the pose nearest to the middle of all, in both directions, for every candidate view."""
    rotations, positions = problem.motion(state.offset_s)
    every = Rotation.from_matrix(rotations)
    nearest = int(np.argmin((every.mean().inv() * every).magnitude()))
    for axis, side in product(range(3), (1, -1)):
        turned = rotations[nearest] @ Rotation.from_rotvec(side * _TURN_RAD * np.eye(3)[axis]).as_matrix()
        for points, seen, where in _list_views(problem, state, sheet):
            platform = state.rotation @ seen + state.translation
            if isinstance(problem.shape, SphereShape):
                position = (state.artefact[:3] - turned @ platform) / state.scale
            else:
                normal = state.artefact[:3]
                there = turned @ platform + state.scale * positions[nearest]
                off = problem.shape.distances(state.artefact, there[None])[0]
                position = positions[nearest] - off * normal / state.scale
                points = _move_to_plane(points, seen, turned @ state.rotation, normal, sheet)
            if points is None:
                continue
            # Without a trajectory the pose has no information on the time offset.
            at = turned[None], position[None]
            alone = replace(problem, points=[points], motion=lambda offset, at=at: at)
            added = RestrictedEstimate(alone, state, np.array(scatter))
            text = (
                f"turn the platform by {np.degrees(side * _TURN_RAD):+.0f} deg about its {'xyz'[axis]} axis from pose "
                f"{names[nearest]}, with the {problem.shape.kind} {where}"
            )
            yield Candidate(words=text, information=added.information[0], pose=rigid_transform(turned, position))


def _list_views(problem: Problem, state: MountState, sheet: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, str]]:
    """Return candidate views: points (n, 3) of the artefact and its place (3,), sensor frame, and a description."""
    flat = to_sheet(problem.points, sheet)
    low, high = np.quantile(np.vstack(flat), (0.1, 0.9), axis=0)
    views = []
    if isinstance(problem.shape, SphereShape):
        rotations, positions = problem.motion(state.offset_s)
        platform = np.einsum("pji,pj->pi", rotations, state.artefact[:3] - state.scale * positions) - state.translation
        centres = (platform @ state.rotation - sheet[:3, 3]) @ sheet[:3, :3]
        low, high = np.quantile(centres[:, [0, 2]], (0.1, 0.9), axis=0)
        radius = float(state.artefact[3])
        depth = min(max(float(np.quantile(np.abs(centres[:, 1]), 0.8)), 0.4 * radius), 0.7 * radius)
        facing = np.vstack([each - centre[[0, 2]] for each, centre in zip(flat, centres, strict=True)])
        middle = np.arctan2(*facing.mean(axis=0)[::-1])
        angle = middle + np.linspace(-1, 1, _POINTS) * np.radians(60)
        for u, w, y in product((low[0], high[0]), (low[1], high[1]), (depth, -depth)):
            section = np.sqrt(radius**2 - y**2)
            arc = np.column_stack([u + section * np.cos(angle), np.zeros(_POINTS), w + section * np.sin(angle)])
            views.append((arc, np.array([u, y, w])))
    else:
        for u, w in product((low[0], high[0]), (low[1], high[1])):
            line = np.column_stack([np.linspace(low[0], high[0], _POINTS), np.zeros(_POINTS), np.full(_POINTS, w)])
            views.append((line, np.array([u, 0.0, w])))
    both = [tuple(each @ sheet[:3, :3].T + sheet[:3, 3] for each in view) for view in views]
    where = "at x = {:.0f}, y = {:.0f}, z = {:.0f} mm of the sensor's frame".format
    return [(points, place, where(*place)) for points, place in both]


def _move_to_plane(
    points: np.ndarray, seen: np.ndarray, to_base: np.ndarray, normal: np.ndarray, sheet: np.ndarray
) -> np.ndarray | None:
    """Move points along the sheet's z axis onto the plane through ``seen``; None if it is steeper than 60 deg."""
    inside, down = normal @ to_base, sheet[:3, 2]
    steep = float(inside @ down)
    return None if abs(steep) < 0.5 else points - np.outer((points - seen) @ inside / steep, down)  # 60 deg


def require_determined(covariance: np.ndarray, weak: Sequence[str], advised: NextPose | None = None) -> None:
    """Raise CalibrationError if the covariance (6, 6) of a mount leaves a direction undetermined; ``weak`` names it."""
    shift, turn = (np.sqrt(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1]) for k in (0, 3))
    if shift > _OPEN_MM or turn > OPEN_RAD:
        raise CalibrationError(
            f"the poses do not determine the mount: {'; '.join(weak)}"
            f"{'' if advised is None else f'. Next pose to add: {advised.words}'}"
        )


def weaknesses(covariance: np.ndarray, rotations: Rotation, *, table: bool) -> list[str]:
    """Describe weakly determined directions of a mount, and missing rotations of the platform."""
    lines, near = [], ": the artefact stays at nearly the same place in front of the sensor"
    limits = (
        (0, _OPEN_MM, _LEAST_MM, "shift along", "mm", 1.0, ""),
        (3, OPEN_RAD, _LEAST_RAD, "turn about", "deg", np.degrees(1.0), near),
    )
    for first, limit, least, what, unit, size, why in limits:
        variances, axes = np.linalg.eigh(covariance[first : first + 3, first : first + 3])
        stds = np.sqrt(np.maximum(variances, 0.0))
        for std, axis in zip(stds, axes.T, strict=True):
            if std > min(_WEAK * stds[int(table)], limit) and std > least:
                known = f"known to {std * size:.2g} {unit} only" if std < limit else "open"
                lines.append(f"the {what} {describe_axis(axis)} is {known}{why}")
    return lines if table else lines + describe_missing_turns(rotations)


def describe_axis(direction: np.ndarray) -> str:
    """Describe a direction of the platform."""
    place = int(np.argmax(np.abs(direction)))
    if abs(direction[place]) > 0.94:  # within 20 deg
        return f"the platform's {'xyz'[place]} axis"
    return f"the platform's direction ({', '.join(f'{each:.2f}' for each in direction)})"


def describe_missing_turns(rotations: Rotation, *, least_rad: float = _LEAST_TURN_RAD) -> list[str]:
    """Describe the axes with insufficient rotation of the platform; empty if it rotates about two axes.

    Rotations about one axis only leave the shift along this axis undetermined. ``least_rad`` is the minimum RMS
    rotation.
    """
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    if np.linalg.eigvalsh(vectors.T @ vectors / len(vectors))[1] >= least_rad**2:
        return []
    return [
        f"insufficient rotation about {describe_axis(axis)} ({np.degrees(size):.1f} deg rms)"
        for size, axis in zip(np.sqrt(np.mean(vectors**2, axis=0)), np.eye(3), strict=True)
        if size < least_rad
    ]
