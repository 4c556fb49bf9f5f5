"""Camera calibration with the offset between a circle's image and the image of its centre taken out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from uwlts.calibration.camera import CameraSolution, Poses, solve_camera
from uwlts.calibration.intrinsics import CameraOptions
from uwlts.calibration.target_images import TargetImage
from uwlts.model.errors import CalibrationError
from uwlts.model.sensor import Camera
from uwlts.optics.camera import project
from uwlts.targets.detection.ellipse_bias import circle_centre_bias

Solve = Callable[[Sequence[TargetImage], CameraSolution | None], CameraSolution]

_ROUNDS = 10  # a few settle, unless the diameter is wrong
_X, _Y = np.eye(3)[:2]


def centre_offsets(
    project: Callable[[np.ndarray], np.ndarray], pose: np.ndarray, points_mm: np.ndarray, *, diameter_mm: float
) -> np.ndarray:
    """Offsets (N, 2) in px of the centres of circles' images from the images of the circles' centres.

    The circles lie in the plane of a target at ``T_camera_target`` (4, 4); ``project`` maps points (M, 3) of the camera
    frame to pixels (M, 2).

    Raises RangeError: a circle's image is no ellipse.
    """

    def seen(points: np.ndarray) -> np.ndarray:
        return project(points @ pose[:3, :3].T + pose[:3, 3])

    return circle_centre_bias(seen, points_mm, diameter_mm=diameter_mm, axis_u=_X, axis_v=_Y)


@dataclass(frozen=True, eq=False)
class UnbiasedSolution:
    """A calibration from circle centres: the solution, the offsets (N, 2) in px taken out of each image, the rounds."""

    solution: CameraSolution
    bias_px: list[np.ndarray]
    rounds: int

    def largest_bias_px(self) -> float:
        """Longest offset over all circles."""
        return max(float(np.max(np.hypot(*bias.T))) for bias in self.bias_px)


def solve_target(
    images: Sequence[TargetImage],
    camera: Camera,
    *,
    circle_diameter_mm: float | None,
    poses: Poses,
    approaching: bool,
    options: CameraOptions,
    start: CameraSolution | None = None,
) -> tuple[CameraSolution, UnbiasedSolution | None]:
    """The camera as `solve_camera` finds it, without the offsets of the circles' images where a diameter is given."""

    def solved(images: Sequence[TargetImage], better: CameraSolution | None) -> CameraSolution:
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        return solve_camera(
            images, **size, poses=poses, approaching=approaching, options=options, start=better or start
        )

    if circle_diameter_mm is None:
        return solved(images, None), None
    unbiased = solve_without_bias(images, solved, diameter_mm=circle_diameter_mm)
    return unbiased.solution, unbiased


def solve_without_bias(
    images: Sequence[TargetImage], solve: Solve, *, diameter_mm: float, tolerance_px: float = 1e-4
) -> UnbiasedSolution:
    """Calibrate, calculate the offsets of the circles' images, take them out, and again until they stay.

    Parameters
    ----------
    images : pixels are centres of the circles' images
    solve : callable; images and a solution to start from, or None, to a solution
    diameter_mm : of the circles
    tolerance_px : largest change of an offset at which the rounds end

    Raises
    ------
    CalibrationError
        As `solve` does, or the offsets do not settle.
    RangeError
        A circle's image is no ellipse.
    """
    bias = [np.zeros_like(image.pixels) for image in images]
    solution = None
    for rounds in range(1, _ROUNDS + 1):
        centred = [replace(i, pixels=i.pixels - offset) for i, offset in zip(images, bias, strict=True)]
        solution = solve(centred, solution)
        seen_by = partial(project, solution.model)
        before, bias = (
            bias,
            [
                centre_offsets(seen_by, pose, image.points_mm, diameter_mm=diameter_mm)
                for image, pose in zip(images, solution.target_poses, strict=True)
            ],
        )
        if max(np.max(np.abs(b - a)) for a, b in zip(before, bias, strict=True)) <= tolerance_px:
            return UnbiasedSolution(solution, before, rounds)
    raise CalibrationError(
        f"the offsets of the circles' images did not settle in {_ROUNDS} rounds: is the circles' diameter "
        f"{diameter_mm:g} mm?"
    )
