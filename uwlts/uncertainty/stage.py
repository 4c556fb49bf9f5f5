"""What the stage of a scan leaves open: its scale and its direction move points by how far it has gone."""

import numpy as np

from uwlts.calibration.joint.stored import StoredEstimate
from uwlts.calibration.joint.surface_scans import SLOPES, across_of
from uwlts.calibration.model import Calibration
from uwlts.calibration.parameter_keys import StageParameter
from uwlts.capture import CaptureHeader


def stage_root(known: StoredEstimate, calibration: Calibration, header: CaptureHeader, root: np.ndarray) -> np.ndarray:
    """How independent parts move a point (R + E, 3) for each mm that the stage has gone; OCS.

    What the estimate knows of the stage goes with its own parts, ``root`` (P, R). The others are as the sensor's
    description says, and the scale that was found, as it is not applied to scans.
    """
    described, uncertainty = np.array(header.stage_direction), header.sensor.uncertainty
    keys = known.parameters.keys
    found = calibration.stage_of(header.stage_direction)
    sign = 1.0 if found is None or found[1] else -1.0
    ways = dict(zip(SLOPES, sign * across_of(sign * described), strict=True)) | {StageParameter.SCALE: described}
    calibrated = [key for key in ways if key in keys and (key not in SLOPES or found is not None)]
    lean = float(np.tan(np.radians(uncertainty.stage_alignment_deg)))
    std = dict.fromkeys(SLOPES, lean) | {StageParameter.SCALE: uncertainty.stage_scale}
    within = sum((np.outer(root[keys.index(key)], ways[key]) for key in calibrated), np.zeros((root.shape[1], 3)))
    besides = [std[key] * way for key, way in ways.items() if key not in calibrated]
    besides.append(known.parameters.value(known.values, StageParameter.SCALE) * described)
    return np.vstack([within, *besides])
