"""The next pass: a motion of the sensor relative to the scene, and the uncertainty of lengths that it would leave."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.calibration.joint.observability import project_sheet_points
from uwlts.fitting.next_observation import Candidate, CovarianceRoot, Forecast, eliminate_others, rank_candidates
from uwlts.model.calibration import rigid_transform
from uwlts.recalibration.pass_estimate import OF_PASS, Pass, PassProblem, PassSolution

_SHIFTS = (0.2, 0.4, 0.6)
"""Shifts along the stripe, relative to the width of the scene in that direction."""
_LIFTS_MM = (20.0, 40.0, 60.0, 80.0)
_TURNS_DEG = (90.0, 180.0)
_ROLLS_DEG = (15.0, 30.0)
_LEAST_OVERLAP = 0.3
"""Smallest fraction of the cells that a candidate must see, so that poses and surface stay connected."""


def rank_passes(problem: PassProblem, solution: PassSolution, lengths: np.ndarray) -> list[Forecast]:
    """Return the effect of further passes on lengths with derivatives (L, U), the most helpful one first."""
    known = CovarianceRoot.from_covariance(solution.covariance)
    return rank_candidates(known, lengths, _list_candidates(problem, solution))


def _list_candidates(problem: PassProblem, solution: PassSolution) -> Iterator[Candidate]:
    cells = solution.cells
    places, normals = np.array([cell.middle_mm for cell in cells]), np.array([cell.normal for cell in cells])
    # The information and the mean row of all passes in a cell, and a typical pass's information.
    weight = np.array([np.sum(1 / cell.std**2) for cell in cells])
    each = weight / np.array([len(cell.passes) for cell in cells])
    rows = np.array([cell.mean_row for cell in cells])
    first = problem.passes[0]
    for text, pose, single in _list_motions(first.pose[len(first.pose) // 2], places):
        seen = _predict_view(problem, solution, pose, places)
        if seen is None or np.count_nonzero(seen[1]) < _LEAST_OVERLAP * len(cells):
            continue
        placed, there = seen
        count = problem.unknowns
        by = np.einsum("ni,niu->nu", normals[there], placed)
        by[:, :count] -= rows[there]
        information = (by.T / (1 / each[there] + 1 / weight[there]) / solution.spread**2) @ by
        information[count:, count:] += np.eye(len(information) - count)
        yield Candidate(words=text, information=eliminate_others(information, count), pose=pose, single=single)


def _list_motions(start: np.ndarray, places: np.ndarray) -> Iterator[tuple[str, np.ndarray, bool]]:
    """Iterate over motions from the first pass: text, pose (4, 4), and whether it is a single motion."""
    axes, middle = start[:3, :3], places.mean(axis=0)
    width = float(np.ptp((places - middle) @ axes[:, 1]))
    shifts = [sign * round(part * width, -1) or sign * 5.0 for part in _SHIFTS for sign in (1, -1)]
    lifts = [sign * far for far in _LIFTS_MM for sign in (1, -1)]
    steps = [(f"shift {far:+.0f} mm along Y", far * axes[:, 1]) for far in shifts]
    lifted = [(f"move {abs(far):.0f} mm {'closer' if far > 0 else 'farther away'}", far * axes[:, 2]) for far in lifts]
    turns = [(f"turn by {deg:.0f} deg about Z", deg * axes[:, 2]) for deg in _TURNS_DEG]
    turns += [
        (f"roll by {sign * deg:+.0f} deg about X", sign * deg * axes[:, 0]) for deg in _ROLLS_DEG for sign in (1, -1)
    ]
    for text, vector in (*steps, *lifted):
        yield text, rigid_transform(np.eye(3), vector) @ start, True
    for text, vector in turns:
        rotation = Rotation.from_rotvec(vector, degrees=True).as_matrix()
        for also, shift in (("", np.zeros(3)), *((f"{lift} and ", shift) for lift, shift in lifted)):
            moved = rigid_transform(rotation, middle - rotation @ middle + shift)
            yield f"{also}{text}, about the middle of the scene", moved @ start, not also


def _predict_view(
    problem: PassProblem, solution: PassSolution, pose: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return derivatives (n, 3, U + `OF_PASS`) of the places that a pass would see, and their mask (N,)."""
    known = problem.moved(solution.amplitudes)
    direction = problem.stage_direction(solution.amplitudes)
    local = (places - pose[:3, 3]) @ pose[:3, :3]
    travel = local[:, 0] / direction[0]
    pixels = project_sheet_points(known, (local - travel[:, None] * direction)[:, 1:])
    camera = known.calibration.camera
    inside = np.isfinite(pixels).all(axis=1) & (pixels >= 0).all(axis=1)
    inside &= (pixels[:, 0] < camera.width_px - 1) & (pixels[:, 1] < camera.height_px - 1)
    if not inside.any():
        return None
    across, chosen = known.across(), pixels[inside]
    count = int(inside.sum())
    none = np.zeros(count)
    frame, beside = np.zeros(count, int), np.zeros((count, 3))
    extra = Pass("", frame, chosen[:, 1 - across], chosen[:, across], none, beside, travel[inside], pose[None])
    start = np.append(solution.amplitudes[: problem.of_sensor], np.zeros(OF_PASS))
    placed = replace(problem, passes=[extra]).place(start, [none])
    shared = problem.of_sensor
    result = np.zeros((count, 3, problem.unknowns + OF_PASS))
    result[:, :, :shared] = placed.by_unknowns[:, :, :shared]
    result[:, :, problem.unknowns :] = placed.by_unknowns[:, :, shared:]
    return result, inside
