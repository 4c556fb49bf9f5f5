"""Camera calibration with the offset between a circle's image and the image of its centre taken out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.camera import CameraSolution
from uwlts.calibration.target_images import TargetImage
from uwlts.model.errors import CalibrationError
from uwlts.optics.camera import project
from uwlts.targets.detection.ellipse_bias import circle_centre_bias

Solve = Callable[[Sequence[TargetImage], CameraSolution | None], CameraSolution]

_ROUNDS = 10
_X, _Y = np.eye(3)[:2]


@dataclass(frozen=True, eq=False)
class UnbiasedSolution:
    """A calibration from circle centres: the solution, the offsets (N, 2) in px taken out of each image, the rounds."""

    solution: CameraSolution
    bias_px: list[np.ndarray]
    rounds: int

    def largest_bias_px(self) -> float:
        """Longest offset over all circles."""
        return max(float(np.max(np.hypot(*bias.T))) for bias in self.bias_px)


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
        before, bias = (
            bias,
            [
                circle_centre_bias(
                    _projection(solution, index), image.points_mm, diameter_mm=diameter_mm, axis_u=_X, axis_v=_Y
                )
                for index, image in enumerate(images)
            ],
        )
        if max(np.max(np.abs(b - a)) for a, b in zip(before, bias, strict=True)) <= tolerance_px:
            return UnbiasedSolution(solution, before, rounds)
    raise CalibrationError(
        f"the offsets of the circles' images did not settle in {_ROUNDS} rounds: is the circles' diameter "
        f"{diameter_mm:g} mm?"
    )


def _projection(solution: CameraSolution, index: int) -> Callable[[np.ndarray], np.ndarray]:
    pose = solution.target_poses[index]
    return lambda points: project(solution.model, points @ pose[:3, :3].T + pose[:3, 3])
