"""A calibration beside another one of the same sensor: parameters, and where points move over the volume."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.stored import StoredEstimate
from uwlts.calibration.joint.volume import Region, estimate_in, pixels_at
from uwlts.calibration.model import Calibration
from uwlts.certificate.form import without_rigid_motion
from uwlts.errors import CalibrationError
from uwlts.reconstruction import points_on_sheet

_ROWS, _COLUMNS = 17, 21


@dataclass(frozen=True, eq=False)
class Change:
    """How points of the same pixels lie by a calibration against another one, mm.

    Attributes
    ----------
    at_mm : (R, C, 2)
        Y and Z.
    moved_mm : (R, C, 3)
        In X, Y and Z of the OCS, with a rigid motion of all taken out.
    largest_mm : float
        Before that.
    """

    at_mm: np.ndarray
    moved_mm: np.ndarray
    largest_mm: float


def require_same_sensor(calibration: Calibration, other: Calibration) -> None:
    """CalibrationError where two calibrations cannot be of one sensor."""
    for name, pair in {
        "image size": [f"{c.camera.width_px} x {c.camera.height_px} px" for c in (calibration, other)],
        "stripe_along": [c.stripe_along for c in (calibration, other)],
    }.items():
        if pair[0] != pair[1]:
            raise CalibrationError(
                f"the calibrations are of different sensors: {name} is {pair[0]} in one and {pair[1]} in the other"
            )


def change_from(calibration: Calibration, other: Calibration, region: Region) -> Change:
    """What a calibration changed against another one, in its region.

    Raises
    ------
    CalibrationError
        The other one is of another sensor, or sees no sheet somewhere in the region.
    """
    require_same_sensor(calibration, other)
    known: StoredEstimate = estimate_in(calibration, region)
    mesh = region.mesh(_ROWS, _COLUMNS)
    pixels = pixels_at(calibration, known, mesh.reshape(-1, 2))
    points = []
    for each in (calibration, other):
        through = each if region.view.window else each.model_copy(update={"window": None})
        found = points_on_sheet(through, pixels, medium_index=each.index_of(region.medium)).points_camera_mm
        if not np.isfinite(found).all():
            raise CalibrationError("one of the calibrations sees no sheet somewhere in the volume: they do not compare")
        points.append(found)
    moved = (points[0] - points[1]) @ calibration.object_transform()[:3, :3]
    form = without_rigid_motion(mesh.reshape(-1, 2), moved[None])[0]
    return Change(mesh, form.reshape(*mesh.shape[:2], 3), float(np.linalg.norm(moved, axis=1).max()))
