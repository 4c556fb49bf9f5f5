"""Calibration of a sensor as it was built: the described values with the uncertainties of the drawing."""

import numpy as np

from uwlts.calibration.camera.camera_parameters import DISTORTION
from uwlts.calibration.joint.gathering import HELD
from uwlts.calibration.joint.parameters import SHEET, DescribedSheet, Prior, fan_priors, window_priors
from uwlts.errors import CalibrationError
from uwlts.model.calibration import Calibration, KnownMedium
from uwlts.model.joint_estimate import JointEstimate
from uwlts.model.parameter_keys import LensParameter, MediumIndex, ParameterKey
from uwlts.model.sensor import Medium, Sensor, to_rows
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
    known, camera, sheet = sensor.uncertainty, plain.camera, DescribedSheet.from_sensor(sensor)
    turn = float(np.radians(known.sheet_turn_deg))
    focal = _FOCAL if known.focal_length is None else max(known.focal_length, HELD)
    index = medium.refractive_index(sensor.laser.wavelength_nm)
    priors: dict[ParameterKey, Prior] = {LensParameter.F: Prior(camera.fx_px, focal * camera.fx_px)}
    described = camera.parameters()
    priors |= {
        key: Prior(described[key.text], known.tangential)
        for key in LensParameter
        if key.text in DISTORTION and described[key.text] != 0.0
    }
    priors |= window_priors(plain.window, known)
    priors[MediumIndex("medium")] = Prior(index, medium.index_uncertainty(sensor.laser.wavelength_nm, known))
    placed = (turn, turn, known.sheet_offset_mm)
    priors |= {key: Prior(0.0, std) for key, std in zip(SHEET[:3], placed, strict=True)} | fan_priors(sensor, wet=True)
    entries = {key: prior for key, prior in priors.items() if prior.std > 0}
    std = tuple(prior.std for prior in entries.values())
    joint = JointEstimate(
        parameters=tuple(entries),
        values=tuple(prior.mean for prior in entries.values()),
        std=std,
        std_before=std,
        covariance=to_rows(np.diag(np.square(std))),
        nominal_sheet=sheet.nominal(),
        scatter_px={},
        residual_count=0,
        outlier_count=0,
    )
    model = sheet.model(np.array([priors[key].mean if key in priors else 0.0 for key in SHEET]))
    return plain.model_copy(
        update={"media": (KnownMedium(medium=medium, index=index),), "sheet": model, "joint": joint}
    )
