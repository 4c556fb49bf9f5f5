"""How the window's distance depends on the step images it is found from, and what it does to spheres (Table 4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.evidence import step_evidence
from uwlts.calibration.model import Calibration
from uwlts.calibration.procedure import nominal_window, step_image
from uwlts.calibration.window import StepImage, solve_window, step_profile
from uwlts.capture import Capture
from uwlts.errors import CalibrationError
from uwlts.reconstruction import reconstruct_pixels
from uwlts.thesis.folder import STEP_PLACES, CampaignFolder
from uwlts.thesis.sphere_scan import SphereScan

_TRIED_SHARES = (0.25, 0.5, 1.0, 1.5)
"""Window distances of Figure 45, as shares of the calibrated one."""


@dataclass(frozen=True)
class WindowChoice:
    """Window distance found from some step images, and the mean absolute sphere spacing error that it leads to.

    None where the images determine no distance within its bounds.
    """

    images: str
    distance_mm: float | None
    mean_sse_mm: float | None


def mean_spacing_error(calibration: Calibration, scans: Sequence[SphereScan]) -> float:
    """Mean absolute sphere spacing error of scans in mm."""
    return float(np.mean([abs(spacing_error(calibration, scan)) for scan in scans]))


def spacing_error(calibration: Calibration, scan: SphereScan, *, medium_index: float | None = None) -> float:
    """Sphere spacing error of a scan in mm, in a medium of another index if one is given."""
    points = reconstruct_pixels(
        calibration, scan.pixels, medium_index=medium_index or scan.medium_index,
        stage_mm=scan.stage_mm, stage_direction=scan.stage_direction,
    )  # fmt: skip
    return scan.spacing_error(points.points_mm)


def window_choices(
    folder: CampaignFolder, calibration: Calibration, scans: Sequence[SphereScan]
) -> tuple[list[WindowChoice], list[dict[str, object]]]:
    """Every step image alone, the three of each place, and all nine; and profiles of a step at several distances.

    Returns
    -------
    choices : list of WindowChoice
        ``images`` is the place and the image's number (from 1), the place alone, or "all".
    profiles : list of dict
        For Figure 45: ``distance_mm`` and points (N, 2), Y and Z in mm, of one step image seen through a window at
        that distance.
    """
    images = _step_images(folder, calibration)
    subsets = {f"{place} {number}": [image] for place in images for number, image in enumerate(images[place], start=1)}
    subsets |= images | {"all": [image for place in images for image in images[place]]}
    choices = []
    for name, chosen in subsets.items():
        try:
            window = solve_window(calibration, calibration.window, chosen).model
        except CalibrationError:
            choices.append(WindowChoice(name, None, None))
            continue
        moved = calibration.model_copy(update={"window": window})
        choices.append(WindowChoice(name, window.distance_mm, mean_spacing_error(moved, scans)))
    shown = images[STEP_PLACES[1]][0]
    profiles = []
    for share in _TRIED_SHARES:
        window = calibration.window.model_copy(update={"distance_mm": share * calibration.window.distance_mm})
        profile = step_profile(calibration, window, shown.pixels, medium_index=shown.medium_index)
        seen = profile[np.isfinite(profile).all(axis=1)][::4]
        profiles.append({"distance_mm": window.distance_mm, "points_mm": np.round(seen, 4).tolist()})
    return choices, profiles


def _step_images(folder: CampaignFolder, calibration: Calibration) -> dict[str, list[StepImage]]:
    """Step images by place, with their treads told apart."""
    found = {}
    for place, path in zip(STEP_PLACES, folder.steps(), strict=True):
        with Capture(path) as capture:
            evidence, _ = step_evidence([capture])
            described = nominal_window(
                capture.header.sensor.camera.window, capture.header.sensor, refractions=calibration.window.refractions
            )
        found[place] = [step_image(calibration, described, step) for step in evidence]
    return found
