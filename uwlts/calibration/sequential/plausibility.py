"""Plausibility of stated sizes in a sequential calibration: target against stage, and step against its images."""

import math
from collections.abc import Sequence

import numpy as np

from uwlts.calibration.camera.target_images import TargetImage
from uwlts.calibration.camera.target_poses import CameraSolution
from uwlts.calibration.sequential.step_images import StepImage
from uwlts.calibration.sequential.window_distance import WindowSolution
from uwlts.model.sensor import Uncertainty

# Limits for doubts about stated sizes. Chosen on views of the as-built thesis sensor without drawn pixels, two draws of
# each fault; judged on other draws and on drawn images of a coarse sensor.
_ROUGH = 2e-3  # least relative error: the usual error of sizes that are stated without an uncertainty
_SIGMAS = 4.0  # least error in standard uncertainties: one normal error in 16,000 is larger
_FEWEST_STEPS = 4  # images of a step for its height: fewer leave no scatter beside distance and height


def doubt_target_size(images: Sequence[TargetImage], free: CameraSolution, *, known: Uncertainty) -> list[str]:
    """Compare distances between target poses with the travel of the stage; return a warning if they contradict.

    ``free`` is the camera from the same images with one free pose per image: its lengths are those of the target's
    spacing.
    """
    placement = np.array([image.placement for image in images])
    stage, places = np.array([image.stage_mm for image in images]), free.target_poses[:, :3, 3].copy()
    squares, moved, rests, freedom = 0.0, 0.0, 0.0, 0
    for number in set(placement.tolist()):
        here = placement == number
        travel, shift = stage[here] - stage[here].mean(), places[here] - places[here].mean(axis=0)
        square, vector = float(travel @ travel), travel @ shift
        length = float(np.linalg.norm(vector))
        if square > 0 and length > 0:
            squares, moved = squares + square, moved + length
            rests += float(np.sum((shift @ vector / length - travel * length / square) ** 2))
            freedom += int(here.sum()) - 2
    if freedom < 1:
        return []
    std = {name: value / free.model.parameters()[name] for name, value in free.std().items() if name in ("f", "fx")}
    rows, columns = known.stretch_by_axis()
    parts = math.sqrt(rests / freedom / squares), max(std.values(), default=0.0), known.stage_scale, rows, columns
    error, total = moved / squares - 1, math.hypot(*parts)
    if abs(error) <= max(_ROUGH, _SIGMAS * total):
        return []
    return [
        f"distances between the target's poses differ by {100 * error:+.2f} ± {100 * total:.2f} % from the stage's "
        "positions, and all lengths with them: check the target's spacing, and the scale of the stage"
    ]


def doubt_step_height(window: WindowSolution, steps: Sequence[StepImage], *, known: Uncertainty) -> list[str]:
    """Estimate height and window distance together from step images; return a warning if the stated height is wrong.

    At different distances from the sensor, both have different effects on measured heights: at the same distance from
    the sensor, this finds nothing.
    """
    stated = np.array([step.height_mm() for step in steps])
    if len(steps) < _FEWEST_STEPS:
        return []
    design = np.column_stack([window.slopes, -stated])
    found = np.linalg.lstsq(design, -window.errors_mm, rcond=None)[0]
    rest = window.errors_mm + design @ found
    variance = max(float(rest @ rest) / (len(steps) - 2), float(np.mean(window.height_std_mm**2)))
    spread = np.linalg.svd(design / np.linalg.norm(design, axis=0), compute_uv=False)
    if spread[-1] < 1e-6 * spread[0]:
        return []
    std = math.sqrt(variance * np.linalg.inv(design.T @ design)[1, 1])
    total = math.hypot(std, *(step.height_std_mm(known) / step.height_mm() for step in steps[:1]))
    if abs(found[1]) <= max(_ROUGH, _SIGMAS * total):
        return []
    return [
        f"the step fits best with a height {100 * found[1]:+.2f} ± {100 * total:.2f} % from the stated one, and a "
        f"window {window.model.distance_mm + found[0]:.1f} mm from the pupil, not {window.model.distance_mm:.1f} mm: "
        "check the step's height, the medium, and the target's spacing"
    ]
