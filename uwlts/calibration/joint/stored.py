"""A joint estimate read back from its calibration: parameters, values and covariance, also for another medium."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.intrinsics import DISTORTION, CameraOptions, Intrinsics
from uwlts.calibration.joint.parameters import Parameters, Prior, View
from uwlts.calibration.joint.rays import WINDOW
from uwlts.calibration.joint.sheet_jets import DescribedSheet
from uwlts.calibration.model import Calibration
from uwlts.calibration.polynomial_model import PolynomialCalibration
from uwlts.errors import CalibrationError
from uwlts.sensor import Medium, Sensor, Uncertainty


@dataclass(frozen=True, eq=False)
class StoredEstimate:
    """Parameters, their values (P,), their covariance (P, P), and through what a scan was seen."""

    parameters: Parameters
    values: np.ndarray
    covariance: np.ndarray
    view: View


def is_joint(calibration: Calibration | PolynomialCalibration) -> bool:
    """Whether a calibration holds a joint estimate."""
    return isinstance(calibration, Calibration) and "joint" in calibration.residuals


def stored_estimate(calibration: Calibration, sensor: Sensor, medium: Medium) -> StoredEstimate:
    """The estimate of a calibration for scans by a sensor, as their captures describe it, in a medium.

    In a medium that was calibrated in, its index may have drifted since. In another, the index is as known from the
    medium, independent of all else.

    Raises
    ------
    CalibrationError
        The calibration holds no joint estimate, or a damaged one.
    """
    return _read(calibration, medium, mounted=sensor.camera.window.mounted, uncertainty=sensor.uncertainty)


def found_estimate(calibration: Calibration, medium: Medium) -> StoredEstimate:
    """The estimate as its evidence gave it, in one of its media or in air; errors as `stored_estimate`."""
    return _read(calibration, medium, mounted=True, uncertainty=Uncertainty(drift_k=0.0))


def _read(calibration: Calibration, medium: Medium, *, mounted: bool, uncertainty: Uncertainty) -> StoredEstimate:
    if not is_joint(calibration):
        raise CalibrationError("the calibration tells no uncertainty: calibrate jointly (--water or --joint)")
    try:
        return _stored(calibration, medium, mounted=mounted, uncertainty=uncertainty)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CalibrationError(f"the calibration's joint estimate is damaged: {error!r}") from error


def _stored(calibration: Calibration, medium: Medium, *, mounted: bool, uncertainty: Uncertainty) -> StoredEstimate:
    joint, camera = calibration.residuals["joint"], calibration.camera
    names, values = list(joint["parameters"]), np.array(joint["values"], dtype=np.float64)
    covariance = np.array(joint["covariance"], dtype=np.float64)
    options = CameraOptions(
        distortion=tuple(name for name in DISTORTION if name in names),
        square_pixels="f" in names,
        principal_point_px=None if "cx" in names else (camera.cx_px, camera.cy_px),
    )
    intrinsics = Intrinsics(options, width_px=camera.width_px, height_px=camera.height_px)
    sheet = DescribedSheet(**{name: np.array(value) for name, value in joint["described_sheet"].items()})
    media = [name.removeprefix("index of ") for name in names if name.startswith("index of ")]
    if len(media) != len(calibration.media):
        raise ValueError(f"it has {len(media)} indices of media, the calibration {len(calibration.media)} media")
    # As `Calibration.index_of`: the last of equal ones.
    known = next((n for n, found in reversed([*enumerate(calibration.media)]) if found.medium == medium), None)
    window = mounted and calibration.window is not None
    view = View(window, None if medium.kind == "air" else known)
    if known is not None:
        place = names.index(f"index of {media[known]}")
        drift = medium.index_per_kelvin(calibration.wavelength_nm) * uncertainty.drift_k
        covariance[place, place] += drift**2
    elif medium.kind != "air":
        media.append("the scan")
        names.append(f"index of {media[-1]}")
        index = calibration.index_of(medium)
        std = medium.index_uncertainty(calibration.wavelength_nm, uncertainty)
        values = np.append(values, index)
        covariance = np.block(
            [[covariance, np.zeros((len(covariance), 1))], [np.zeros((1, len(covariance))), np.array([[std**2]])]]
        )
        view = View(window, len(media) - 1)
    lens = len(intrinsics.names)
    if tuple(names[:lens]) != intrinsics.names or covariance.shape != (len(names), len(names)):
        raise ValueError("its parameters do not fit together")
    priors = {name: Prior(value, np.inf) for name, value in zip(names[lens:], values[lens:], strict=True)}
    priors |= {name: Prior(value, 0.0) for name, value in _held(calibration).items() if name not in priors}
    return StoredEstimate(
        Parameters(intrinsics, sheet, calibration.window, tuple(media), priors), values, covariance, view
    )


def _held(calibration: Calibration) -> dict[str, float]:
    """What the calibration's models say of window and sheet, for parameters that were held and not estimated."""
    held: dict[str, float] = {}
    if (window := calibration.window) is not None:
        normal = np.array(window.normal) / window.normal[2]
        values = (window.distance_mm, float(normal[0]), float(normal[1]), window.thickness_mm, window.glass_index)
        held |= dict(zip(WINDOW, values, strict=True))
    if (fan := calibration.sheet.fan) is not None:
        held |= {"sheet_bow": fan.bow_rad, "laser_window_turn": fan.window_turn_rad}
    return held
