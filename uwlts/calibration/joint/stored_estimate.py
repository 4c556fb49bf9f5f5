"""A joint estimate read back from its calibration: parameters, values and covariance, also for another medium."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.intrinsics import DISTORTION, CameraOptions, Intrinsics
from uwlts.calibration.joint.derivatives import WINDOW, DescribedSheet
from uwlts.calibration.joint.parameters import Parameters, Prior, View
from uwlts.model.calibration import Calibration
from uwlts.model.errors import CalibrationError
from uwlts.model.joint_estimate import JointEstimate
from uwlts.model.parameter_keys import LensParameter, MediumIndex, ParameterKey, SheetParameter, parameter_of
from uwlts.model.sensor import Medium, Sensor, Uncertainty


@dataclass(frozen=True, eq=False)
class StoredEstimate:
    """Parameters, their values (P,), their covariance (P, P), and through what a scan was seen."""

    parameters: Parameters
    values: np.ndarray
    covariance: np.ndarray
    view: View


def require_joint(calibration: Calibration) -> JointEstimate:
    """The joint estimate of a calibration; CalibrationError where it holds none."""
    if calibration.joint is None:
        raise CalibrationError("the calibration holds no uncertainty: calibrate jointly (--water or --joint)")
    return calibration.joint


def stored_estimate(calibration: Calibration, sensor: Sensor, medium: Medium) -> StoredEstimate:
    """The estimate of a calibration for scans by a sensor, as their captures describe it, in a medium.

    In a medium that was calibrated in, its index may have drifted since. In another, the index is as known from the
    medium, independent of all else.

    Raises CalibrationError: the calibration holds no joint estimate, or a damaged one.
    """
    return _read(calibration, medium, mounted=sensor.camera.window.mounted, uncertainty=sensor.uncertainty)


def found_estimate(calibration: Calibration, medium: Medium) -> StoredEstimate:
    """The estimate as its evidence gave it, in one of its media or in air; errors as `stored_estimate`."""
    return _read(calibration, medium, mounted=True, uncertainty=Uncertainty(drift_k=0.0))


def _read(calibration: Calibration, medium: Medium, *, mounted: bool, uncertainty: Uncertainty) -> StoredEstimate:
    joint, camera = require_joint(calibration), calibration.camera
    keys, values = list(joint.parameters), np.array(joint.values)
    covariance = joint.covariance_matrix()
    options = CameraOptions(
        distortion=tuple(name for name in DISTORTION if parameter_of(name) in keys),
        square_pixels=LensParameter.F in keys,
        principal_point_px=None if LensParameter.CX in keys else (camera.cx_px, camera.cy_px),
    )
    intrinsics = Intrinsics(options, width_px=camera.width_px, height_px=camera.height_px)
    media = [key.medium for key in keys if isinstance(key, MediumIndex)]
    if len(media) != len(calibration.media):
        raise _damaged(f"it has {len(media)} indices of media, the calibration {len(calibration.media)} media")
    # As `Calibration.index_of`: the last of equal ones.
    known = next((n for n, found in reversed([*enumerate(calibration.media)]) if found.medium == medium), None)
    window = mounted and calibration.window is not None
    view = View(window, None if medium.kind == "air" else known)
    if known is not None:
        place = keys.index(MediumIndex(media[known]))
        drift = medium.index_per_kelvin(calibration.wavelength_nm) * uncertainty.drift_k
        covariance[place, place] += drift**2
    elif medium.kind != "air":
        media.append("the scan")
        keys.append(MediumIndex(media[-1]))
        index = calibration.index_of(medium)
        std = medium.index_uncertainty(calibration.wavelength_nm, uncertainty)
        values = np.append(values, index)
        covariance = np.block(
            [[covariance, np.zeros((len(covariance), 1))], [np.zeros((1, len(covariance))), np.array([[std**2]])]]
        )
        view = View(window, len(media) - 1)
    lens = len(intrinsics.names)
    if tuple(keys[:lens]) != intrinsics.keys:
        raise _damaged("its parameters do not fit together")
    priors = {key: Prior(value, np.inf) for key, value in zip(keys[lens:], values[lens:], strict=True)}
    priors |= {key: Prior(value, 0.0) for key, value in _held(calibration).items() if key not in priors}
    sheet = DescribedSheet.of(joint.nominal_sheet)
    return StoredEstimate(
        Parameters(intrinsics, sheet, calibration.window, tuple(media), priors), values, covariance, view
    )


def _damaged(reason: str) -> CalibrationError:
    return CalibrationError(f"the calibration's joint estimate is damaged: {reason}")


def _held(calibration: Calibration) -> dict[ParameterKey, float]:
    """What the calibration's models say of window and sheet, for parameters that were held and not estimated."""
    held: dict[ParameterKey, float] = {}
    if (window := calibration.window) is not None:
        normal = np.array(window.normal) / window.normal[2]
        values = (window.distance_mm, float(normal[0]), float(normal[1]), window.thickness_mm, window.glass_index)
        held |= dict(zip(WINDOW, values, strict=True))
    if (fan := calibration.sheet.fan) is not None:
        held |= {SheetParameter.BOW: fan.bow_rad, SheetParameter.WINDOW_TURN: fan.window_turn_rad}
    return held
