"""What one image of the calibration target contributes: its points, where they appeared, and where the stage was."""

from dataclasses import dataclass

import numpy as np

from uwlts.errors import CalibrationError

_FEWEST = 6
_COLLINEAR = 1e-3


@dataclass(frozen=True, eq=False)
class TargetImage:
    """Target points found in one image.

    Attributes
    ----------
    points_mm : (N, 3)
        In the target's frame, z = 0.
    pixels : (N, 2)
        Where they appear, (u, v).
    stage_mm : float
        Position of the stage that moves the sensor.
    placement : int
        Counts how often the target was put up anew: images of one placement differ by the stage's motion only.
    """

    points_mm: np.ndarray
    pixels: np.ndarray
    stage_mm: float = 0.0
    placement: int = 0

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points_mm, dtype=np.float64)
        pixels = np.ascontiguousarray(self.pixels, dtype=np.float64)
        if points.shape != (len(points), 3) or pixels.shape != (len(points), 2):
            raise ValueError(f"(N, 3) points and (N, 2) pixels expected, not {points.shape} and {pixels.shape}")
        if not (np.isfinite(points).all() and np.isfinite(pixels).all() and np.isfinite(self.stage_mm)):
            raise CalibrationError("a target image holds points, pixels or a stage position that are not finite")
        if len(points) < _FEWEST:
            raise CalibrationError(f"a target image needs at least {_FEWEST} points; there are {len(points)}")
        if np.abs(points[:, 2]).max() > 1e-9 * np.abs(points).max():
            raise CalibrationError("the target's points must lie in its plane z = 0")
        extents = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
        if extents[1] <= _COLLINEAR * extents[0]:
            raise CalibrationError("all points of a target image lie on one line: more of the target must be seen")
        object.__setattr__(self, "points_mm", points)
        object.__setattr__(self, "pixels", pixels)


def z_away(image: TargetImage) -> bool:
    """Whether the target's z axis points away from the camera, told from the sense in which x turns into y."""
    flat = np.column_stack([image.points_mm[:, :2], np.ones(len(image.points_mm))])
    linear = np.linalg.lstsq(flat, image.pixels, rcond=None)[0][:2]
    return bool(np.linalg.det(linear) > 0)
