"""Joint estimate in a calibration: written with a summary of its evidence, and read for any medium."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, count

import numpy as np
from pydantic import JsonValue
from scipy.linalg import block_diag
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from uwlts.calibration.camera.camera_parameters import DISTORTION, CameraOptions, Intrinsics
from uwlts.calibration.joint.estimate import Estimate, Evidence, outliers
from uwlts.calibration.joint.parameters import DescribedSheet, Parameters, Prior, ViewMedium, window_values
from uwlts.calibration.joint.residuals import TARGET, SeenSheet
from uwlts.calibration.sequential.sheet_fit import object_frame
from uwlts.errors import CalibrationError
from uwlts.fitting.propagation import differences
from uwlts.model.calibration import Calibration, KnownMedium
from uwlts.model.joint_estimate import CoveredRegion, ImageFit, JointEstimate
from uwlts.model.parameter_keys import LensParameter, MediumIndex, SheetParameter, WindowParameter, parse_parameter
from uwlts.model.sensor import Medium, Sensor, Table, Uncertainty, to_rows
from uwlts.model.stripe import stack_pixels

_FRAME_STEP = 1e-5
"""Step of the sheet's parameters, rad and mm, for central differences; their error is negligible."""


def build_calibration(
    result: Estimate,
    evidence: Sequence[Evidence],
    sensor: Sensor,
    media: Sequence[Medium],
    provenance: dict[str, JsonValue],
) -> Calibration:
    """Build the calibration of a joint estimate, with its evidence; ``media`` are those other than air."""
    parameters, values = result.parameters, result.values
    sheet = parameters.sheet_model(values)
    frame = object_frame(sheet, laser_axis=parameters.sheet.axis)
    indices = [parameters.medium_index(values, ViewMedium(True, number)) for number in range(len(media))]
    return Calibration(
        sensor_name=sensor.name,
        stripe_along=sensor.camera.stripe_along,
        wavelength_nm=sensor.laser.wavelength_nm,
        medium_kind=media[0].kind if parameters.window is None and media else "air",
        camera=parameters.camera(values),
        window=parameters.window_model(values),
        sheet=sheet,
        camera_from_object=to_rows(frame),
        media=tuple(KnownMedium(medium=m, index=index) for m, index in zip(media, indices, strict=True)),
        residuals=_list_lens_and_window(result),
        joint=_build_joint_estimate(result, evidence, frame),
        provenance=provenance,
    )


def _build_joint_estimate(result: Estimate, evidence: Sequence[Evidence], object_frame: np.ndarray) -> JointEstimate:
    """Build the stored estimate with the fit of each image and the covered regions, with ``T_camera_object`` (4, 4)."""
    images = []
    lit: dict[ViewMedium, list[np.ndarray]] = {}
    for piece, parts in zip(evidence, result.residuals, strict=True):
        for part in parts:
            left_out = outliers(part, result.noise[part.kind])
            used = part.values[~left_out]
            images.append(
                ImageFit(
                    source=piece.sources[part.image],
                    kind=part.kind,
                    rms_px=float(np.sqrt(np.mean(used**2))) if len(used) else None,
                    residual_count=len(part.values),
                    outlier_count=int(left_out.sum()),
                )
            )
            if part.kind != TARGET:
                lit.setdefault(piece.view, []).append(piece.pixels[piece.stripe_pixels(part.image)][~left_out])
    return JointEstimate(
        parameters=result.parameters.keys,
        values=tuple(result.values.tolist()),
        std=tuple(result.std().values()),
        std_before=tuple(float(std) if np.isfinite(std) else None for std in result.parameters.prior_std()),
        covariance=to_rows(result.covariance),
        nominal_sheet=result.parameters.sheet.nominal(),
        scatter_px={kind: noise.sigma_px for kind, noise in result.noise.items()},
        shared_variance={kind: noise.together for kind, noise in result.noise.items()},
        residual_count=sum(len(r.values) for parts in result.residuals for r in parts),
        outlier_count=result.outliers,
        rounds=result.rounds,
        stopped=result.stopped,
        images=tuple(images),
        covered=tuple(
            _build_covered_region(result, view, np.vstack(pixels), object_frame, across=evidence[0].across)
            for view, pixels in lit.items()
        ),
    )


def _list_lens_and_window(result: Estimate) -> dict[str, Table]:
    """Return standard uncertainties of lens and window, with the names of sequential calibrations in files."""
    std = result.std()
    camera: Table = {"std": {key.text: std[key] for key in std if isinstance(key, LensParameter)}}
    if TARGET in result.noise:
        camera["sigma_px"] = result.noise[TARGET].sigma_px
    figures: dict[str, Table] = {"camera": camera}
    if WindowParameter.DISTANCE in std:
        figures["window"] = {"std_mm": std[WindowParameter.DISTANCE]}
    return figures


def _build_covered_region(
    result: Estimate, view: ViewMedium, pixels: np.ndarray, object_frame: np.ndarray, *, across: int
) -> CoveredRegion:
    seen = SeenSheet.from_parameters(result.parameters, result.values, view, pixels, across=across).places_mm()
    if seen is None:
        raise CalibrationError("with the joint estimate, the ray of a used stripe pixel does not meet the sheet")
    at = (object_frame[:3, 1:3].T @ (seen - object_frame[:3, 3:4])).T
    return CoveredRegion(
        medium=view.medium,
        name="air" if view.medium is None else result.parameters.media[view.medium],
        window=view.window,
        point_count=len(at),
        camera_depth_mm=(float(seen[2].min()), float(seen[2].max())),
        outline_mm=to_rows(np.round(convex_outline(at), 3)),
    )


def convex_outline(at: np.ndarray) -> np.ndarray:
    """Return the corners (K, 2) of the convex hull; for collinear points, the ends."""
    try:
        return at[ConvexHull(at).vertices]
    except QhullError:
        along = np.linalg.svd(at - at.mean(axis=0), full_matrices=False)[2][0]
        order = (at - at.mean(axis=0)) @ along
        return at[[int(np.argmin(order)), int(np.argmax(order))]]


@dataclass(frozen=True, eq=False)
class StoredEstimate:
    """Parameters, their values (P,) and covariance (P, P), and the view of a scan."""

    calibration: Calibration
    parameters: Parameters
    values: np.ndarray
    covariance: np.ndarray
    view: ViewMedium

    def project(self, points: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
        """Project points (N, 3) of the camera frame, also by other values (P,); return pixels (N, 2), else NaN."""
        return self.parameters.project(self.values if values is None else values, self.view, points)

    def triangulate(self, line: np.ndarray, centre_px: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return points (N, 3) of stripe centres, and derivatives (N, 3, 1 + P) by the pixel and all parameters.

        The pixel is that across the stripe. The coordinates are in the OCS, fixed relative to the camera. None if a
        centre cannot be triangulated.
        """
        pixels = stack_pixels(line, centre_px, stripe_along=self.calibration.stripe_along)
        found = self.parameters.stripe_points(self.values, self.view, pixels, across=self.across())
        if found is None:
            return None
        frame = self.calibration.object_transform()
        return (found.points.T - frame[:3, 3]) @ frame[:3, :3], np.einsum("ji,njr->nir", frame[:3, :3], found.by)

    @cached_property
    def frame_by(self) -> np.ndarray:
        """Derivatives (6, P) of the OCS by the parameters: shift, mm, and rotation, rad, along its own axes.

        The OCS is defined by the sheet, so it changes with the sheet's parameters.
        """
        axis, inverse = self.parameters.sheet.axis, np.linalg.inv(self.calibration.object_transform())

        def moved(values: np.ndarray) -> np.ndarray:
            frame = inverse @ object_frame(self.parameters.sheet_model(values), laser_axis=axis)
            return np.append(frame[:3, 3], Rotation.from_matrix(frame[:3, :3]).as_rotvec())

        of_sheet = np.array([isinstance(key, SheetParameter) for key in self.parameters.keys])
        return differences(moved, self.values, _FRAME_STEP * of_sheet)

    def across(self) -> int:
        """Return the pixel coordinate that runs across the stripe."""
        return 1 if self.calibration.stripe_along == "width" else 0


def unused_name(name: str, taken: Collection[str]) -> str:
    """Return the name of a new medium, with a number if another has it."""
    names = chain([name], (f"{name} {number}" for number in count(2)))
    return next(each for each in names if each not in taken)


def require_joint(calibration: Calibration) -> JointEstimate:
    """Return the joint estimate of a calibration; raises CalibrationError if it contains none."""
    if calibration.joint is None:
        raise CalibrationError("the calibration has no uncertainty: calibrate jointly (`water` or `joint`)")
    return calibration.joint


def read_stored_estimate(calibration: Calibration, sensor: Sensor, medium: Medium) -> StoredEstimate:
    """Return the estimate of a calibration for scans of a sensor in a medium.

    In a calibrated medium, the uncertainty of the index includes its drift. In another medium, the index follows from
    the medium's description, independent of all other parameters.

    Raises CalibrationError if the calibration contains no joint estimate, or a damaged one.
    """
    return _read_estimate(calibration, medium, mounted=sensor.camera.window.mounted, uncertainty=sensor.uncertainty)


def read_original_estimate(calibration: Calibration, medium: Medium) -> StoredEstimate:
    """Return the estimate as originally calculated, in one of its media or in air; errors as `read_stored_estimate`."""
    return _read_estimate(calibration, medium, mounted=True, uncertainty=Uncertainty(drift_k=0.0))


def _read_estimate(
    calibration: Calibration, medium: Medium, *, mounted: bool, uncertainty: Uncertainty
) -> StoredEstimate:
    joint, camera = require_joint(calibration), calibration.camera
    keys, values = list(joint.parameters), np.array(joint.values)
    covariance = joint.covariance_matrix()
    options = CameraOptions(
        distortion=tuple(name for name in DISTORTION if parse_parameter(name) in keys),
        pixel_aspect=camera.fy_px / camera.fx_px if LensParameter.F in keys else None,
        principal_point_px=None if LensParameter.CX in keys else (camera.cx_px, camera.cy_px),
    )
    intrinsics = Intrinsics(options, width_px=camera.width_px, height_px=camera.height_px)
    media = [key.medium for key in keys if isinstance(key, MediumIndex)]
    if len(media) != len(calibration.media):
        raise _make_damage_error(f"it has {len(media)} indices for {len(calibration.media)} media")
    # As in `Calibration.medium_index`: the last of equal media.
    known = next((n for n, found in reversed([*enumerate(calibration.media)]) if found.medium == medium), None)
    seen_in = None if medium.kind == "air" else known
    if known is not None:
        place = keys.index(MediumIndex(media[known]))
        drift = medium.index_per_kelvin(calibration.wavelength_nm) * uncertainty.drift_k
        covariance[place, place] += drift**2
    elif medium.kind != "air":
        seen_in = len(media)
        media.append(unused_name("the scan", media))
        keys.append(MediumIndex(media[-1]))
        values = np.append(values, calibration.medium_index(medium))
        std = medium.index_uncertainty(calibration.wavelength_nm, uncertainty)
        covariance = np.asarray(block_diag(covariance, std**2))
    lens = len(intrinsics.names)
    if tuple(keys[:lens]) != intrinsics.keys:
        raise _make_damage_error("its parameters are inconsistent with the camera")
    # Fixed parameters of window and sheet are read from the calibration's models.
    held = {} if calibration.window is None else window_values(calibration.window)
    if (fan := calibration.sheet.fan) is not None:
        held |= {SheetParameter.BOW: fan.bow_rad, SheetParameter.WINDOW_TURN: fan.window_turn_rad}
    priors = {key: Prior(value, np.inf) for key, value in zip(keys[lens:], values[lens:], strict=True)}
    priors |= {key: Prior(value, 0.0) for key, value in held.items() if key not in priors}
    sheet = DescribedSheet.from_description(joint.nominal_sheet)
    parameters = Parameters(intrinsics, sheet, calibration.window, tuple(media), priors)
    view = ViewMedium(mounted and calibration.window is not None, seen_in)
    return StoredEstimate(calibration, parameters, values, covariance, view)


def _make_damage_error(reason: str) -> CalibrationError:
    return CalibrationError(f"the calibration's joint estimate is damaged: {reason}")
