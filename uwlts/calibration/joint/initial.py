"""Initial values of the joint estimate: camera, poses and sheet, and lines of steps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from uwlts.calibration.camera import CameraSolution, placement_pose, solve_camera
from uwlts.calibration.intrinsics import DISTORTION, CameraOptions, Intrinsics
from uwlts.calibration.joint.derivatives import DescribedSheet
from uwlts.calibration.joint.evidence import StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.gathering import Gathered, Series
from uwlts.calibration.joint.parameters import Parameters, Prior, View
from uwlts.calibration.sheet import fit_sheet, object_frame
from uwlts.calibration.target_images import Placement
from uwlts.calibration.window import label_step
from uwlts.metrology.step_faces import StepFace
from uwlts.model.calibration import Calibration, CameraModel, SheetModel, WindowModel
from uwlts.model.errors import CalibrationError, EvaluationError
from uwlts.model.parameter_keys import StepHeight
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Sensor
from uwlts.optics.camera import directions
from uwlts.optics.window import trace_window

_LARGEST_MISFIT_PX, _LARGEST_MISFIT = 1.5, 1e-3
"""Pixels, or a share of the focal length: what the stage's errors leave in the images that a start is found from."""
# As robust as a median can be; what is left out here is judged again with the final sheet.
_LARGEST_REJECTED = 0.45


@dataclass(frozen=True, eq=False)
class SeriesStart:
    """Start of lens (L,) and of all placements' local parameters, with the stripes that lie on the target."""

    intrinsics: Intrinsics
    lens: np.ndarray
    evidence: list[TargetEvidence]
    local: list[np.ndarray]

    def calibration(self, sensor: Sensor, window: WindowModel | None, model: SheetModel) -> Calibration:
        """A calibration of the start, good enough to tell the treads of a step apart."""
        frame = object_frame(model, laser_axis=laser_pose(sensor).axis)
        return Calibration(
            sensor_name=sensor.name,
            stripe_along=sensor.camera.stripe_along,
            wavelength_nm=sensor.laser.wavelength_nm,
            camera=self.intrinsics.model(self.lens),
            window=window,
            sheet=model,
            camera_from_object=tuple(map(tuple, frame.tolist())),
        )


def series_start(
    series: Sequence[Series],
    sensor: Sensor,
    window: WindowModel | None,
    indices: Sequence[float],
    *,
    options: CameraOptions,
    free: bool,
    margin_mm: float | None,
) -> SeriesStart:
    """Camera from the series that the window disturbs least, poses of all series, stripes that fall on the target.

    Seen paraxially through the window, a pane d away from the pupil, t thick, of the index g, the medium of the index n
    looks as if a pinhole of n times the focal length stood at d + t - n (d + t / g) on the axis.
    """
    image = sensor.camera
    intrinsics = Intrinsics(options, width_px=image.width_px, height_px=image.height_px)
    base = min(series, key=lambda s: (s.view.medium is not None, s.view.window, -len(s.found.images)))
    staged = not free and base.approaching is not None
    seen = solve_camera(
        base.found.images,
        width_px=image.width_px,
        height_px=image.height_px,
        poses="stage-normal" if staged else "free",
        approaching=bool(base.approaching),
        options=options,
    )
    if not base.view.window and base.view.medium is None:
        _refuse_misfits(base, seen)
    lens = intrinsics.from_model(seen.model)
    index = _index(base.view, indices)
    for place, name in enumerate(intrinsics.names):
        lens[place] /= index if name in ("f", "fx", "fy") else index**2 if name in DISTORTION else 1.0
    camera, evidence, local = intrinsics.model(lens), [], []
    for part in series:
        seen_by = _Viewpoint.of(camera, part.view, window, indices)
        alone = free or part.approaching is None
        for placement in part.placements(free=free):
            pose = seen_by.pose(placement)
            piece = _evidence(part, placement, seen_by, pose, sensor, margin_mm, staged=not alone)
            evidence.append(piece)
            local.append(pose if alone else np.concatenate([pose, np.zeros(2 + len(piece.images()))]))
    return SeriesStart(intrinsics, lens, evidence, local)


def sheet_start(
    start: SeriesStart, sensor: Sensor, window: WindowModel | None, indices: Sequence[float]
) -> tuple[DescribedSheet, np.ndarray] | None:
    """The sheet as described, and turns and shift (3,) to the plane through the stripes that the window disturbs least.

    None where no stripe falls on the target.

    Raises CalibrationError: the stripes do not lie on a plane, or do not determine one.
    """
    views = {e.view for e in start.evidence if len(e.stripe_pixels)}
    if not views:
        return None
    view = min(views, key=lambda v: (v.medium is not None, v.window))
    seen_by = _Viewpoint.of(start.intrinsics.model(start.lens), view, window, indices)
    points = []
    for piece, local in zip(start.evidence, start.local, strict=True):
        if piece.view == view and len(piece.stripe_pixels):
            moved = piece.stripe_shifts_mm[:, None] * piece.placement.direction(np.empty(0))
            at = seen_by.on_target(piece.stripe_pixels, local, moved)
            points.append((at - moved) @ cv2.Rodrigues(local[:3])[0].T + local[3:6])
    pose, glass = laser_pose(sensor), sensor.laser.window
    sheet = fit_sheet(np.vstack(points), nominal_normal=pose.normal, largest_rejected=_LARGEST_REJECTED).model
    normal, along = np.array(sheet.normal), sheet.normal @ pose.normal
    middle = camera_from_object(sensor)[:3, 3]
    outer = glass.distance_mm + glass.thickness_mm if glass.mounted else 0.0
    described = DescribedSheet(pose.normal, pose.axis, middle, pose.origin_mm, pose.origin_mm + outer * pose.axis)
    turns = (normal @ pose.axis / along, normal @ pose.fan / along)
    return described, np.array([*turns, sheet.offset_mm - normal @ middle])


def _refuse_misfits(series: Series, seen: CameraSolution) -> None:
    """CalibrationError where a camera without a window in air does not explain the images by and large."""
    rms = seen.image_rms_px()
    if np.median(rms) <= max(_LARGEST_MISFIT_PX, _LARGEST_MISFIT * seen.model.fx_px):
        return
    capture, frame = series.found.frames[int(np.argmax(rms))]
    raise CalibrationError(
        f"no camera explains the target images in air: {np.median(rms):.1f} px (rms) are left in most of them, and "
        f"{rms.max():.1f} px in {series.names[capture]}, frame {frame}: check the target's spacing, the stage's "
        "positions, and that all captures come from the same camera and medium"
    )


def _index(view: View, indices: Sequence[float]) -> float:
    """Index behind the window; without one the lens itself looks into the medium, whatever it is."""
    return indices[view.medium] if view.window and view.medium is not None else 1.0


@dataclass(frozen=True, eq=False)
class _Viewpoint:
    """A camera with the window in its view and the index behind it."""

    camera: CameraModel
    window: WindowModel | None
    index: float

    @classmethod
    def of(cls, camera: CameraModel, view: View, window: WindowModel | None, indices: Sequence[float]) -> "_Viewpoint":
        return cls(camera, window if view.window else None, _index(view, indices))

    def pose(self, placement: Placement) -> np.ndarray:
        """Rotation vector and shift (6,) of a placement, seen through the window as if from a single viewpoint."""
        rays = directions(self.camera, placement.pixels)
        if not np.isfinite(rays).all():
            raise CalibrationError("the distortion found first has no inverse where the target is seen: fix some of it")
        seen = replace(placement, pixels=rays[:, :2] / rays[:, 2:])
        pose, window = placement_pose(seen, np.diag([self.index, self.index, 1.0])), self.window
        if window is not None:
            outer = window.distance_mm + window.thickness_mm
            pose[5] += outer - self.index * (window.distance_mm + window.thickness_mm / window.glass_index)
        return pose

    def on_target(self, pixels: np.ndarray, pose: np.ndarray, moved_mm: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the moved target where rays meet it, in its frame; NaN where one does not."""
        rays = trace_window(directions(self.camera, pixels), self.window, medium_index=self.index)
        rotation = cv2.Rodrigues(pose[:3])[0]
        start = (rays.origins - pose[3:6]) @ rotation + moved_mm
        along = rays.directions @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            return start - (start[:, 2] / along[:, 2])[:, None] * along


def _evidence(
    series: Series,
    placement: Placement,
    seen_by: _Viewpoint,
    pose: np.ndarray,
    sensor: Sensor,
    margin_mm: float | None,
    *,
    staged: bool,
) -> TargetEvidence:
    found = series.found
    numbers = np.unique(placement.image)
    pixels = np.vstack([found.stripes[number] for number in numbers])
    image = np.repeat(numbers, [len(found.stripes[number]) for number in numbers])
    stage_mm = np.array([entry.stage_mm for entry in found.images])
    shifts = stage_mm[image] - stage_mm[placement.image[0]] if staged else np.zeros(len(image))
    extent = found.target.extent_mm
    margin = found.target.spacing_mm / 2 if margin_mm is None else margin_mm
    at = seen_by.on_target(pixels, pose, shifts[:, None] * placement.direction(np.empty(0)))
    hull = ConvexHull(extent).equations
    with np.errstate(invalid="ignore"):
        on_target = (at[:, :2] @ hull[:, :2].T + hull[:, 2] <= margin).all(axis=1)
    middle = extent.mean(axis=0)
    return TargetEvidence(
        view=series.view,
        placement=placement,
        stripe_pixels=pixels[on_target],
        stripe_image=image[on_target],
        stripe_shifts_mm=shifts[on_target],
        across=1 if sensor.camera.stripe_along == "width" else 0,
        staged=staged,
        radius_mm=float(np.linalg.norm(extent - middle, axis=1).max()),
        middle_mm=middle,
    )


def step_profiles(
    gathered: Gathered, start: Calibration, window: WindowModel | None
) -> tuple[list[tuple[StepProfileEvidence, Prior]], list[str]]:
    """Evidence of every step image with what is known of its height, by a calibration nearly as sought; warnings."""
    transform = start.object_transform()
    usual = gathered.sensor.uncertainty.step_height_mm
    found, warnings = [], []
    for number, (step, view) in enumerate(gathered.steps):
        try:
            image = label_step(start, window, step)
        except EvaluationError as error:
            warnings.append(f"{step.source}: left out, {error}")
            continue
        on_tread = image.labels != StepFace.NEITHER
        height, stated = step.standard.height_mm, step.standard.height_uncertainty_mm
        evidence = StepProfileEvidence(
            view=view,
            pixels=image.pixels[on_tread],
            upper=image.labels[on_tread] == StepFace.UPPER,
            upward=-transform[:3, 2],
            along=transform[:3, 1],
            across=1 if gathered.sensor.camera.stripe_along == "width" else 0,
            height=StepHeight(height),
            image=number,
        )
        found.append((evidence, Prior(height, stated / 2 if stated else usual)))
    return found, warnings


def line_start(evidence: StepProfileEvidence, parameters: Parameters, global_values: np.ndarray) -> np.ndarray:
    """The lower tread's line (2,) at the parameters' start."""
    points = parameters.on_sheet(global_values, evidence.view, evidence.pixels)
    if points is None:
        raise CalibrationError("the stripe on a step meets no sheet at the calibration's start: check the window")
    up = evidence.upward @ points.points - evidence.upper * parameters.value(global_values, evidence.height)
    along = evidence.along @ points.points
    slope, offset = np.polyfit(along, up, 1)
    return np.array([-slope, offset / np.hypot(1.0, slope)])
