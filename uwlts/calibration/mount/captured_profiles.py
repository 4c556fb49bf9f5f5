"""Profiles of a capture for a mount calibration, and propagation of the sensor's uncertainty to the mount."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uwlts.calibration.camera.lens import LensCalibration
from uwlts.calibration.joint.stored_estimate import StoredEstimate, read_stored_estimate
from uwlts.calibration.mount.restricted_likelihood import RestrictedEstimate
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.calibration import Calibration, calibration_digest
from uwlts.model.mount import SensorShare
from uwlts.model.sensor import to_rows
from uwlts.optics.fitness import check_fits
from uwlts.optics.triangulation import reconstruct_profile
from uwlts.storage.capture import Capture
from uwlts.stripe import find_stripes


@dataclass(frozen=True, eq=False)
class CapturedProfiles:
    """Profiles of a calibrated sensor on a platform, one for each laser image of a capture.

    ``profiles`` are P arrays (n, 3) in the sensor's frame, mm. ``stripes`` are their profile lines and stripe centres
    (n, 2), ``times_s`` (P,) their times. ``poses`` (M, 4, 4) are ``T_base_platform``, at ``pose_times_s`` (M,) if
    known. ``known`` is the joint estimate of the sensor's calibration, if it has one.
    """

    profiles: Sequence[np.ndarray]
    stripes: Sequence[np.ndarray]
    times_s: np.ndarray
    poses: np.ndarray
    pose_times_s: np.ndarray | None
    known: StoredEstimate | None

    def point_derivatives(self, number: int, rows: np.ndarray) -> np.ndarray:
        """Return derivatives (n, 3, Q) of points of a profile by the parameters of the joint estimate, sensor frame."""
        assert self.known is not None
        found = self.known.triangulate(*self.stripes[number][rows].T)
        if found is None:
            raise CalibrationError("a stripe centre cannot be triangulated with the calibration's joint estimate")
        return found[1][:, :, 1:]


def reconstruct_profiles(
    capture: Capture, calibration: Calibration, poses: np.ndarray | None, pose_times_s: np.ndarray | None
) -> CapturedProfiles:
    """Reconstruct the profiles of all laser images of a capture; ``poses`` replace the capture's own poses.

    Raises DescriptionError if images have no pose and ``poses`` is None.
    """
    check_fits(capture.header, calibration, source=capture.path.name)
    mounted = capture.header.sensor.camera.window.mounted
    stripes, laser = find_stripes(capture), np.flatnonzero(capture.laser_on)
    points = reconstruct_profile(
        calibration if mounted else calibration.model_copy(update={"window": None}),
        stripes.line,
        stripes.centre_px,
        medium_index=calibration.medium_index(capture.header.medium),
    ).points_mm
    times = capture.time_s[laser]
    at = capture.pose[laser] if poses is None else poses
    if poses is None:
        pose_times_s = times
        if missing := int(np.count_nonzero(~np.isfinite(at).all(axis=(1, 2)))):
            raise DescriptionError(
                f"{missing} of {len(laser)} laser images of {capture.path.name} have no platform pose: give a table of "
                "poses, or import the poses"
            )
    known = None
    if calibration.joint is not None:
        known = read_stored_estimate(calibration, capture.header.sensor, capture.header.medium)
    found = np.column_stack([stripes.line, stripes.centre_px])
    profiles, where = ([each[stripes.frame == frame] for frame in laser] for each in (points, found))
    return CapturedProfiles(profiles, where, times, at, pose_times_s, known)


def mount_covariance(
    estimate: RestrictedEstimate[Any],
    free: np.ndarray,
    rotation: np.ndarray,
    known: StoredEstimate | LensCalibration | None,
    moved: Callable[[], np.ndarray],
) -> tuple[np.ndarray, SensorShare | None, float]:
    """Return the covariance (K, K) of a mount estimate, the sensor's contribution, and the coverage factor.

    ``free`` (K, size) maps parameters to all values, ``rotation`` (3, 3) is the mount's. ``moved`` returns the
    derivatives (G, K, Q) of the residuals by the parameters of ``known``: the joint estimate of a sensor, or a camera.
    The factor is for 95 %.
    """
    fitted = free @ estimate.covariance @ free.T
    covariance, share = fitted, None
    if known is not None:
        by = free @ estimate.propagate(moved())
        if isinstance(known, StoredEstimate):
            covariance, share = _add_sensor_uncertainty(fitted, by, rotation, known)
        else:
            covariance = fitted + by @ known.covariance @ by.T
    estimated = np.flatnonzero(np.diag(fitted)[:6] > 0)
    shares = (np.diag(fitted) / np.where(np.diag(covariance) > 0, np.diag(covariance), 1.0))[estimated]
    return (covariance + covariance.T) / 2, share, estimate.coverage_factor(shares, free[estimated])


def _add_sensor_uncertainty(
    estimated: np.ndarray, by_parameters: np.ndarray, rotation: np.ndarray, known: StoredEstimate
) -> tuple[np.ndarray, SensorShare]:
    """Add the uncertainty of the sensor's calibration to the covariance (K, K) of a mount.

    ``estimated`` (K, K) is the covariance without the sensor's uncertainty, ``by_parameters`` (K, Q) the derivatives by
    the joint estimate's parameters. Both start with shift and rotation of the mount, whose rotation is ``rotation``.
    The mount maps from the sensor's frame (OCS) of the true sheet, so the uncertainty of this frame is included.
    """
    joint = known.calibration.joint
    assert joint is not None
    count = len(joint.parameters)
    # Uncertainty that is not part of the calibration: drift of the water's index, or another water.
    besides = known.covariance.copy()
    besides[:count, :count] -= joint.covariance_matrix()
    independent = estimated + by_parameters @ besides @ by_parameters.T
    in_true_frame, frame = by_parameters.copy(), known.frame_by
    in_true_frame[:6] += np.vstack([rotation @ frame[:3], rotation @ frame[3:]])
    total = estimated + in_true_frame @ known.covariance @ in_true_frame.T
    share = SensorShare(
        calibration=calibration_digest(known.calibration),
        by_parameters=to_rows(by_parameters[:6, :count]),
        covariance_apart=to_rows(((independent + independent.T) / 2)[:6, :6]),
    )
    return (total + total.T) / 2, share
