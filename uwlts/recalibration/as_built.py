"""Calibration of a sensor as it was built: the described values with the uncertainties of the drawing."""

import numpy as np

from uwlts.calibration.camera.camera_parameters import DISTORTION
from uwlts.calibration.joint.parameters import SHEET, DescribedSheet, window_values
from uwlts.errors import CalibrationError
from uwlts.model.calibration import Calibration, KnownMedium
from uwlts.model.joint_estimate import JointEstimate
from uwlts.model.parameter_keys import LensParameter, MediumIndex, ParameterKey
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Medium, Sensor
from uwlts.optics.nominal import nominal_calibration

_FOCAL = 0.01
"""Relative standard uncertainty of a focal length that is not stated: names are rounded, and focusing changes it."""


def as_built(sensor: Sensor, medium: Medium) -> Calibration:
    """Return the described calibration of a sensor in a medium, with the covariance of its table [uncertainty].

    Raises CalibrationError if the camera has no window, or the medium is air.
    """
    if not sensor.camera.window.mounted or medium.kind == "air":
        raise CalibrationError(
            "a description replaces a calibration only for a camera behind a window in a liquid: calibrate instead"
        )
    plain = nominal_calibration(sensor)
    assert plain.window is not None
    known, camera, pose = sensor.uncertainty, plain.camera, laser_pose(sensor)
    glass = sensor.laser.window
    outer = glass.distance_mm + glass.thickness_mm if glass.mounted else 0.0
    middle = np.array(plain.camera_from_object)[:3, 3]
    sheet = DescribedSheet(pose.normal, pose.axis, middle, pose.origin_mm, pose.origin_mm + outer * pose.axis)
    tilt, focal = np.tan(np.radians(known.window_tilt_deg)), known.focal_length or _FOCAL
    turn = float(np.radians(known.sheet_turn_deg))
    index = medium.refractive_index(sensor.laser.wavelength_nm)
    entries: dict[ParameterKey, tuple[float, float]] = {LensParameter.F: (camera.fx_px, focal * camera.fx_px)}
    distortion = camera.parameters()
    entries |= {
        key: (distortion[key.text], known.tangential)
        for key in LensParameter
        if key.text in DISTORTION and distortion[key.text] != 0.0
    }
    std = (known.window_distance_mm, tilt, tilt, known.glass_thickness_mm, known.glass_index)
    entries |= {key: (value, each) for (key, value), each in zip(window_values(plain.window).items(), std, strict=True)}
    entries[MediumIndex("medium")] = (index, medium.index_uncertainty(sensor.laser.wavelength_nm, known))
    turned = float(np.arcsin(glass.normal()[0])) if glass.mounted else 0.0
    values = (0.0, 0.0, 0.0, float(np.radians(sensor.laser.bow_deg)), turned)
    bow, window = np.radians([known.bow_deg, known.laser_window_tilt_deg if glass.mounted else 0.0])
    spread = (turn, turn, known.sheet_offset_mm, bow, window)
    entries |= {key: (value, each) for key, value, each in zip(SHEET, values, spread, strict=True)}
    entries = {key: pair for key, pair in entries.items() if pair[1] > 0}
    found = np.array([*entries.values()])
    joint = JointEstimate(
        parameters=tuple(entries),
        values=tuple(found[:, 0].tolist()),
        std=tuple(found[:, 1].tolist()),
        std_before=tuple(found[:, 1].tolist()),
        covariance=tuple(map(tuple, np.diag(found[:, 1] ** 2).tolist())),
        nominal_sheet=sheet.nominal(),
        scatter_px={},
        residual_count=0,
        outlier_count=0,
    )
    model = sheet.model(np.array(values))
    return plain.model_copy(
        update={"media": (KnownMedium(medium=medium, index=index),), "sheet": model, "joint": joint}
    )
