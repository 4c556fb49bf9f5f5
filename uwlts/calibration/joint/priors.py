"""What is known before anything is seen: from drawings, data sheets and thermometers."""

import numpy as np

from uwlts.calibration.joint.gathering import Gathered
from uwlts.calibration.joint.parameters import Prior
from uwlts.calibration.joint.sheet_derivatives import PARAMETERS as SHEET
from uwlts.calibration.joint.surface_scans import SLOPES
from uwlts.calibration.model import WindowModel
from uwlts.calibration.parameter_keys import (
    MediumIndex,
    ParameterKey,
    SheetParameter,
    StageParameter,
    StepHeight,
    TargetParameter,
    WindowParameter,
)
from uwlts.calibration.procedure import CalibrationOptions


def priors_of(
    gathered: Gathered, window: WindowModel | None, indices: list[float], turns: np.ndarray,
    heights: dict[StepHeight, Prior], options: CalibrationOptions,
) -> dict[ParameterKey, Prior]:  # fmt: skip
    """What is known of all global parameters but the lens's.

    Parameters
    ----------
    window : WindowModel or None
        As described.
    indices : list of float
        Of the media, as described.
    turns : (3,)
        Where the sheet's turns and shift start.
    heights : dict
        Of the step standards.
    """
    sensor, known = gathered.sensor, gathered.sensor.uncertainty
    priors: dict[ParameterKey, Prior] = {}
    if window is not None:
        tilt = float(np.tan(np.radians(known.window_tilt_deg)))
        normal = np.array(window.normal) / window.normal[2]
        priors |= {
            WindowParameter.DISTANCE: Prior(window.distance_mm, known.window_distance_mm),
            WindowParameter.SLOPE_X: Prior(float(normal[0]), tilt),
            WindowParameter.SLOPE_Y: Prior(float(normal[1]), tilt),
            WindowParameter.THICKNESS: Prior(window.thickness_mm, known.glass_thickness_mm),
            WindowParameter.GLASS_INDEX: Prior(window.glass_index, known.glass_index),
        }
    for (name, medium), index in zip(gathered.media.items(), indices, strict=True):
        std = medium.index_uncertainty(sensor.laser.wavelength_nm, known)
        priors[MediumIndex(name)] = Prior(index, known.index if options.medium_index else std)
    priors |= {key: Prior(float(value), np.inf) for key, value in zip(SHEET[:3], turns, strict=True)}
    bow, turn = np.radians([known.bow_deg, known.laser_window_tilt_deg])
    priors[SheetParameter.BOW] = Prior(float(np.radians(sensor.laser.bow_deg)), float(bow))
    if gathered.media and sensor.laser.window.mounted:
        priors[SheetParameter.WINDOW_TURN] = Prior(float(np.arcsin(sensor.laser.window.normal()[0])), float(turn))
    if gathered.scans:
        lean = float(np.tan(np.radians(known.stage_alignment_deg)))
        priors |= dict.fromkeys(SLOPES, Prior(0.0, lean))
    if options.poses != "free" or gathered.scans:
        priors[StageParameter.SCALE] = Prior(0.0, known.stage_scale)
    priors[TargetParameter.BOW] = Prior(0.0, known.target_bow_mm)
    return priors | heights
