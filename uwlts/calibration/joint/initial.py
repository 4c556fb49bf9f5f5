"""Initial values of the joint estimate: camera, poses and sheet, lines of steps, surfaces of scans."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import assert_never

import cv2
import numpy as np

from uwlts.calibration.camera.camera_parameters import DISTORTION, CameraOptions, Intrinsics, Placement, placements
from uwlts.calibration.camera.target_poses import (
    CameraSolution,
    placement_pose,
    refuse_turned_travel,
    solve_camera,
    stage_direction,
)
from uwlts.calibration.joint.gathering import Gathered, Scanned, ScanStripes, Series, list_added_tangential
from uwlts.calibration.joint.parameters import DescribedSheet, Parameters, Prior, ViewMedium
from uwlts.calibration.joint.residuals import StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import (
    LEAST_SHARE,
    ScannedPipe,
    ScannedPlane,
    ScannedSpheres,
    Surface,
    SurfaceScanEvidence,
    perpendicular_directions,
)
from uwlts.calibration.joint.stored_estimate import StoredEstimate
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.calibration.sequential.sheet_fit import fit_sheet, object_frame
from uwlts.calibration.sequential.step_images import label_steps
from uwlts.errors import CalibrationError, EvaluationError
from uwlts.evaluation.artefact_figures import evaluate_pipe, evaluate_plane, evaluate_spheres
from uwlts.model.artefacts import PipeStandard, PlaneStandard, SphereStandard
from uwlts.model.calibration import Calibration, CameraModel, SheetModel, WindowModel
from uwlts.model.parameter_keys import StepHeight
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Sensor, to_rows
from uwlts.model.stripe import stack_pixels
from uwlts.optics.brightness import BLUR_STD, IlluminatedPoints, brightness_shift_std
from uwlts.optics.camera import directions
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.optics.window import trace_window
from uwlts.shapes.step import StepFace

_LARGEST_MISFIT_PX = 1.5  # largest median residual of the images that a start is found from, caused by stage errors
_LARGEST_MISFIT = 1e-3  # the same divided by the focal length, for high-resolution images; the larger limit applies
_DRAWN = 4  # images that are drawn together to find some that are right: the fewest that determine a camera well
_DRAWS = 25  # if 30 % of the images are wrong, one draw of four is right in all of 25 but once in a thousand
_ODD = 8.0
"""Ratio to the scatter of the best drawn images above which an image is wrong: distortion, which is left out here, and
the chance that made them the best change it by a factor of three."""
_FINEST_PX = 0.25  # scatter that images with some distortion have
_LARGEST_REJECTED = 0.45
"""Largest fraction of stripe points off the start's sheet: the limit of a median; inliers are selected again later.
"""
_MOST_POINTS = 2000  # points of a scan: more add little, as errors of neighbours are correlated
_FEWEST_POINTS = 100  # points of an image of a scan, before thinning: with fewer, it shows the rim of a body
_STEEPEST = 0.3
"""Relative brightness slope per mm of the stage above which the origin of the light is uncertain."""


@dataclass(frozen=True, eq=False)
class SeriesStart:
    """Start values of the lens (L,) and of all placements' local parameters, with the stripes on the target.

    Sensor, window and the ``indices`` of the media are as described.
    """

    sensor: Sensor
    window: WindowModel | None
    indices: Sequence[float]
    intrinsics: Intrinsics
    lens: np.ndarray
    evidence: list[TargetEvidence]
    local: list[np.ndarray]

    def calibration(self, sheet: SheetModel) -> Calibration:
        """Return a calibration from the start values, accurate enough to separate the faces of a step."""
        frame = object_frame(sheet, laser_axis=laser_pose(self.sensor).axis)
        return Calibration(
            sensor_name=self.sensor.name,
            stripe_along=self.sensor.camera.stripe_along,
            wavelength_nm=self.sensor.laser.wavelength_nm,
            camera=self.intrinsics.model(self.lens),
            window=self.window,
            sheet=sheet,
            camera_from_object=to_rows(frame),
        )

    def sheet(self) -> tuple[DescribedSheet, np.ndarray] | None:
        """Return the described sheet, and rotations and shift (3,) to the plane through the stripes.

        Only stripes with the least influence of the window are used; None if no stripe is on the target.

        Raises CalibrationError if the stripes are not on a plane, or do not determine one.
        """
        views = {e.view for e in self.evidence if len(e.pixels)}
        if not views:
            return None
        view = min(views, key=lambda v: (v.medium is not None, v.window))
        seen_by = _Viewpoint(self.intrinsics.model(self.lens), self.window, self.indices, view)
        points = []
        for piece, local in zip(self.evidence, self.local, strict=True):
            if piece.view == view and len(piece.pixels):
                moved = piece.shifts_mm[:, None] * piece.placement.direction(np.empty(0))
                at = seen_by.on_target(piece.pixels, local, moved)
                points.append((at - moved) @ cv2.Rodrigues(local[:3])[0].T + local[3:6])
        pose = laser_pose(self.sensor)
        sheet = fit_sheet(
            np.vstack(points),
            nominal_normal=pose.normal,
            nominal_offset_mm=float(pose.normal @ pose.origin_mm),
            largest_rejected=_LARGEST_REJECTED,
        ).model
        normal, along = np.array(sheet.normal), sheet.normal @ pose.normal
        described = DescribedSheet.from_sensor(self.sensor)
        turns = (normal @ pose.axis / along, normal @ pose.fan / along)
        return described, np.array([*turns, sheet.offset_mm - normal @ described.middle_mm])


def estimate_series_start(
    series: Sequence[Series],
    sensor: Sensor,
    window: WindowModel | None,
    indices: Sequence[float],
    *,
    options: CalibrationOptions,
    earlier: StoredEstimate | None = None,
) -> SeriesStart:
    """Estimate the camera from the series with the least influence of the window, then all poses and stripes.

    The window has the distance d, thickness t and index g; the medium has the index n. In the paraxial approximation,
    they act like a pinhole at d + t - n (d + t / g) on the axis, with n times the focal length.

    ``series`` are target images of each medium, with or without window; indices are relative to air. An
    ``earlier`` estimate states the camera.

    Raises CalibrationError if a camera without a window in air does not approximately fit the images, or they are
    rotated or mirrored against the stage.
    """
    width_px, height_px, free = sensor.camera.width_px, sensor.camera.height_px, options.poses == "free"
    camera = options.camera.with_described_pixels(sensor.camera)
    tangential = tuple(key.text for key in list_added_tangential(camera, sensor.uncertainty))
    extended = replace(camera, distortion=(*camera.distortion, *tangential))
    intrinsics = Intrinsics(extended, width_px=width_px, height_px=height_px)
    if earlier is not None:
        intrinsics = earlier.parameters.intrinsics
        lens = earlier.values[: len(intrinsics.names)]
    elif sensor.uncertainty.focal_length == 0:
        lens = intrinsics.from_model(CameraModel.from_description(sensor.camera))
    else:
        base = min(series, key=lambda s: (s.view.medium is not None, s.view.window, -len(s.found.images)))
        solve = _make_camera_solver(base, sensor, options)
        try:
            seen = solve(base.found.images, options=camera)
        except CalibrationError:  # coefficients that are not determined start at zero
            seen = solve(base.found.images, options=replace(camera, distortion=()))
        rms = seen.image_rms_px()
        if base.view == ViewMedium(False, None) and not np.median(rms) <= _find_misfit_px(seen.model.fx_px):
            raise CalibrationError(
                f"no camera fits the target images in air: the median residual is {np.median(rms):.1f} px (rms), and "
                f"{rms.max():.1f} px in {base.found.names()[np.argmax(rms)]}: check the target's spacing, the stage's "
                "positions, and that all captures are from the same camera and medium"
            )
        lens = intrinsics.from_model(seen.model)
        index = _find_index_behind_window(base.view, indices)
        for place, name in enumerate(intrinsics.names):
            lens[place] /= index if name in ("f", "fx", "fy") else index**2 if name in DISTORTION else 1.0
    start = SeriesStart(sensor, window, indices, intrinsics, lens, [], [])
    for part in series:
        seen_by = _Viewpoint(intrinsics.model(lens), window, indices, part.view)
        staged = not free and part.approaching is not None
        # Images are joined by the stage's motion, unless poses are free.
        for placement in placements(part.found.images, approaching=None if free else part.approaching):
            pose = seen_by.pose(placement)
            piece = _build_target_evidence(part, placement, seen_by, pose, sensor, staged=staged)
            start.evidence.append(piece)
            start.local.append(np.append(pose, np.zeros(2 + len(piece.images()) if staged else 0)))
        if free:
            _refuse_turned_images(part, start.local[-len(part.found.images) :], sensor)
    return start


def _make_camera_solver(series: Series, sensor: Sensor, options: CalibrationOptions) -> Callable[..., CameraSolution]:
    """Return the function that calibrates a camera without a window from images of a series."""
    return partial(
        solve_camera,
        width_px=sensor.camera.width_px,
        height_px=sensor.camera.height_px,
        poses="free" if options.poses == "free" or series.approaching is None else "stage-normal",
        approaching=bool(series.approaching),
    )


def _find_misfit_px(focal_px: float) -> float:
    return max(_LARGEST_MISFIT_PX, _LARGEST_MISFIT * focal_px)


def find_odd_images(series: Series, sensor: Sensor, *, options: CalibrationOptions) -> dict[str, str]:
    """Return images that contradict most others, by name with a message; empty if no few images agree.

    Of many draws of a few images, those that a camera fits best are taken to be right; each other image is added alone.
    """
    solve, images = _make_camera_solver(series, sensor, options), series.found.images
    if len(images) <= _DRAWN:
        return {}
    pinhole, rng = CameraOptions((), sensor.camera.pixel_aspect), np.random.default_rng(0)

    def misfit_px(numbers: Iterable[int]) -> float:
        with suppress(CalibrationError):
            return float(solve([images[number] for number in numbers], options=pinhole).image_rms_px().max())
        return np.inf

    draws = rng.permuted(np.tile(np.arange(len(images)), (_DRAWS, 1)), axis=1)[:, :_DRAWN].tolist()
    agree_px, best = min((misfit_px(draw), draw) for draw in draws)
    if agree_px > _find_misfit_px(sensor.camera.focal_length_px()):
        return {}
    off_px = {name: misfit_px({*best, number}) for number, name in enumerate(series.found.names())}
    return {
        name: f"{name}: the target is {f'{off:.1f} px off' if off < np.inf else 'as no camera sees it'}; other "
        f"images agree to {agree_px:.2f} px (rms)"
        for name, off in off_px.items()
        if off > _ODD * max(agree_px, _FINEST_PX)
    }


def _refuse_turned_images(series: Series, poses: Sequence[np.ndarray], sensor: Sensor) -> None:
    """Raise an error if free poses (6,) imply a stage direction that fits rotated images only."""
    target_poses = np.tile(np.eye(4), (len(poses), 1, 1))
    target_poses[:, :3, 3] = [pose[3:6] for pose in poses]
    stage_mm, capture = (np.array([getattr(i, n) for i in series.found.images]) for n in ("stage_mm", "placement"))
    for number, direction in enumerate(series.directions):
        of_capture = capture == number
        if of_capture.any():
            travel = stage_direction(target_poses[of_capture], stage_mm[of_capture])
            refuse_turned_travel(travel, camera_from_object(sensor)[:3, :3] @ direction)


def _find_index_behind_window(view: ViewMedium, indices: Sequence[float]) -> float:
    """Return the index behind the window; without a window the lens model includes the medium."""
    return indices[view.medium] if view.window and view.medium is not None else 1.0


class _Viewpoint:
    """Camera with the window in its view and the index behind it."""

    def __init__(self, camera: CameraModel, window: WindowModel | None, indices: Sequence[float], view: ViewMedium):
        self._camera, self._window, self._index = (
            camera,
            window if view.window else None,
            _find_index_behind_window(view, indices),
        )

    def pose(self, placement: Placement) -> np.ndarray:
        """Estimate rotation vector and shift (6,) of a placement; the window is approximated by a single viewpoint."""
        rays = directions(self._camera, placement.pixels)
        if not np.isfinite(rays).all():
            raise CalibrationError("the initial distortion has no inverse at some target points: fix some coefficients")
        seen = replace(placement, pixels=rays[:, :2] / rays[:, 2:])
        pose, window = placement_pose(seen, np.diag([self._index, self._index, 1.0])), self._window
        if window is not None:
            outer = window.distance_mm + window.thickness_mm
            pose[5] += outer - self._index * (window.distance_mm + window.thickness_mm / window.glass_index)
        return pose

    def on_target(self, pixels: np.ndarray, pose: np.ndarray, moved_mm: np.ndarray) -> np.ndarray:
        """Intersect rays of pixels with the shifted target; return points (N, 3) in its frame, else NaN."""
        rays = trace_window(directions(self._camera, pixels), self._window, medium_index=self._index)
        rotation = cv2.Rodrigues(pose[:3])[0]
        start = (rays.origins - pose[3:6]) @ rotation + moved_mm
        along = rays.directions @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            return start - (start[:, 2] / along[:, 2])[:, None] * along


def _build_target_evidence(
    series: Series, placement: Placement, seen_by: _Viewpoint, pose: np.ndarray, sensor: Sensor, *, staged: bool
) -> TargetEvidence:
    found, numbers = series.found, np.unique(placement.image)
    pixels = np.vstack([found.stripes[number] for number in numbers])
    image = np.repeat(numbers, [len(found.stripes[number]) for number in numbers])
    stage_mm = np.array([entry.stage_mm for entry in found.images])
    shifts = stage_mm[image] - stage_mm[placement.image[0]] if staged else np.zeros(len(image))
    at = seen_by.on_target(pixels, pose, shifts[:, None] * placement.direction(np.empty(0)))
    on_target = found.target.is_on_plate(at[:, :2])
    evidence = TargetEvidence(
        view=series.view,
        placement=placement,
        pixels=pixels,
        image=image,
        shifts_mm=shifts,
        across=1 if sensor.camera.stripe_along == "width" else 0,
        sources={number: found.names()[number] for number in numbers.tolist()},
        staged=staged,
        extent_mm=found.target.extent_mm,
    )
    return evidence.with_stripes(np.flatnonzero(on_target))


def build_step_evidence(
    gathered: Gathered, start: Calibration, window: WindowModel | None
) -> tuple[list[StepProfileEvidence], dict[StepHeight, Prior], list[str]]:
    """Return evidence of every step image, priors of the heights, and warnings, from an approximate calibration.

    The prior of a height includes its certificate and the possible rotation of the standard about the stripe.
    """
    transform, uncertainty = start.object_transform(), gathered.sensor.uncertainty
    found, heights = [], {}
    images, warnings = label_steps(start, window, [step for step, _ in gathered.steps], uncertainty=uncertainty)
    for number, (image, (step, view)) in enumerate(zip(images, gathered.steps, strict=True)):
        if image is None:
            continue
        on_face = image.labels != StepFace.NEITHER
        height = step.standard.height_mm
        evidence = StepProfileEvidence(
            view=view,
            pixels=image.pixels[on_face],
            across=1 if gathered.sensor.camera.stripe_along == "width" else 0,
            sources={number: step.source},
            upper=image.labels[on_face] == StepFace.UPPER,
            upward=-transform[:3, 2],
            along=transform[:3, 1],
            height=StepHeight(height),
            lengthened=image.lengthened,
            image=number,
        )
        found.append(evidence)
        known = heights.get(evidence.height, Prior(height, 0.0))
        heights[evidence.height] = Prior(height, max(known.std, image.height_std_mm(uncertainty)))
    return found, heights, warnings


def estimate_line_start(evidence: StepProfileEvidence, parameters: Parameters, global_values: np.ndarray) -> np.ndarray:
    """Return the lower face's line (2,) at the parameters' start."""
    points = evidence.on_sheet(parameters, global_values).points()
    if points is None:
        raise CalibrationError(
            "the stripe on a step does not meet the sheet of the initial calibration: check the window"
        )
    up = evidence.upward @ points.points - evidence.upper_mm(parameters, global_values)
    slope, offset = np.polyfit(evidence.along @ points.points, up, 1)
    return np.array([-slope, offset / np.hypot(1.0, slope)])


def build_scan_evidence(
    stripes: ScanStripes, start: Calibration, sensor: Sensor, *, medium_index: float, sizes_known: bool, image: int
) -> tuple[SurfaceScanEvidence, np.ndarray]:
    """Return the evidence of a scan and the start of its local parameters, from an approximate calibration.

    Raises EvaluationError if the points do not show the described object.
    """
    found, direction = stripes.found, stripes.stage_direction
    across = 1 if start.stripe_along == "width" else 0
    pixels = stack_pixels(found.line, found.centre_px, stripe_along=start.stripe_along)
    stage_mm = stripes.stage_mm[found.frame]

    def reconstructed(pixels: np.ndarray, stage_mm: np.ndarray) -> np.ndarray:
        return reconstruct_pixels(
            start, pixels, medium_index=medium_index, stage_mm=stage_mm, stage_direction=direction
        ).points_mm

    on_sheet = reconstructed(pixels, stage_mm)
    sheet = IlluminatedPoints.from_calibration(start, sensor, found.line, found.centre_px, medium_index=medium_index)
    beside = sheet.brightness_shift(found.width_px, stripes.slopes, stage_direction=tuple(direction.tolist()))
    points = on_sheet + beside
    # Exclude rims, where few points are left and are unreliable, and fast changes of brightness.
    often = np.bincount(found.frame)[found.frame] >= _FEWEST_POINTS
    good = often & (np.abs(stripes.slopes) < _STEEPEST) & np.isfinite(points).all(axis=1)
    if not good.any():
        raise EvaluationError(f"no image shows it on {_FEWEST_POINTS} sharp, evenly bright profile lines")
    there = np.flatnonzero(good)
    there = there[:: -(-len(there) // _MOST_POINTS)]
    transform = start.object_transform()
    used, surface, local = _fit_surface(stripes.artefact, points[there], transform, sizes_known=sizes_known)
    kept = there[used]
    frames, frame = np.unique(found.frame[kept], return_inverse=True)
    rotation, position_mm = transform[:3, :3], stripes.stage_mm[frames]
    # Shift of the points by light from beside the sheet, as pixels across the stripe.
    per_px = reconstructed(pixels[kept] + np.eye(2)[across], stage_mm[kept]) - on_sheet[kept]
    outward = surface.distances(rotation @ points[kept].T + transform[:3, 3:], local).outward.T @ rotation
    least = LEAST_SHARE * np.linalg.norm(per_px, axis=1)
    beside_px = np.sum(outward * beside[kept], axis=1) / np.maximum(np.abs(np.sum(outward * per_px, axis=1)), least)
    evidence = SurfaceScanEvidence(
        view=stripes.view,
        pixels=pixels[kept],
        across=across,
        sources={image + n: stripes.image_names()[place] for n, place in enumerate(frames)},
        beside_mm=rotation @ beside[kept].T,
        common_px=np.hypot(
            BLUR_STD * stripes.blur_px[kept], brightness_shift_std(sensor.uncertainty) * np.nan_to_num(beside_px)
        ),
        surface=surface,
        frame=frame,
        stage_mm=position_mm,
        direction=rotation @ direction,
        across_stage=perpendicular_directions(direction) @ rotation.T,
        image=image,
    )
    return evidence, np.append(local, np.zeros(len(frames)))


def build_all_scan_evidence(
    scans: Sequence[ScanStripes], start: Calibration, sensor: Sensor, indices: Sequence[float], *, sizes_known: bool
) -> tuple[list[tuple[SurfaceScanEvidence, np.ndarray]], list[str]]:
    """Return the evidence of every scan with the start of its local parameters, and warnings about rejected scans.

    Indices are relative to air; ``sizes_known`` uses the stated sizes of the surfaces.

    Raises CalibrationError if the scans move along different directions.
    """
    found, warnings, image = [], [], 0
    if any(not np.allclose(scan.stage_direction, scans[0].stage_direction) for scan in scans):
        raise CalibrationError("the scans move along different directions: use only scans along one direction")
    for stripes in scans:
        index = 1.0 if stripes.view.medium is None else indices[stripes.view.medium]
        through = start if stripes.view.window else start.model_copy(update={"window": None})
        try:
            evidence, local = build_scan_evidence(
                stripes, through, sensor, medium_index=index, sizes_known=sizes_known, image=image
            )
        except EvaluationError as error:
            warnings.append(f"{stripes.source}: left out, {error}")
            continue
        found.append((evidence, local))
        image += len(evidence.stage_mm)
    return found, warnings


def _fit_surface(
    artefact: Scanned, points: np.ndarray, transform: np.ndarray, *, sizes_known: bool
) -> tuple[np.ndarray, Surface, np.ndarray]:
    """Select the points (N, 3) (OCS) on the surface; return mask (N,), surface in the camera frame, and start (k,).

    Raises EvaluationError if the points do not show the described object.
    """
    rotation = transform[:3, :3]

    def std(expanded_mm: float | None) -> float:
        """Return the standard uncertainty of a certificate; infinite if it is missing or is not to be used."""
        return expanded_mm / 2 if sizes_known and expanded_mm else np.inf

    def in_camera(point_mm: Sequence[float]) -> np.ndarray:
        return rotation @ point_mm + transform[:3, 3]

    match artefact:
        case SphereStandard():
            spheres = evaluate_spheres(points, artefact)
            used = np.isfinite(spheres.deviation_mm)
            centres = np.array([sphere.centre_mm for sphere in spheres.spheres])
            diameters = np.array([sphere.diameter_mm for sphere in spheres.spheres])
            off = np.abs(np.linalg.norm(points[used][:, None] - centres, axis=2) - diameters / 2)
            nominal, spacings = np.array(artefact.diameters_mm), np.array(artefact.spacings_mm)
            surface = ScannedSpheres(
                diameters_mm=nominal,
                diameter_std_mm=np.full(len(nominal), std(artefact.diameter_uncertainty_mm)),
                spacings_mm=spacings,
                spacing_std_mm=np.full(len(spacings), std(artefact.spacing_uncertainty_mm)),
                sphere=np.argmin(off, axis=1),
            )
            return used, surface, np.append((centres @ rotation.T + transform[:3, 3]).ravel(), diameters - nominal)
        case PlaneStandard():
            plane = evaluate_plane(points, artefact)
            normal = np.array(plane.normal)
            surface = ScannedPlane(
                in_camera(plane.point_mm), rotation @ normal, perpendicular_directions(normal) @ rotation.T
            )
            return np.isfinite(plane.deviation_mm), surface, np.zeros(3)
        case PipeStandard():
            pipe = evaluate_pipe(points, artefact)
            axis = np.array(pipe.axis)
            surface = ScannedPipe(
                point_mm=in_camera(pipe.point_mm),
                axis=rotation @ axis,
                across=perpendicular_directions(axis) @ rotation.T,
                diameter_mm=artefact.diameter_mm,
                diameter_std_mm=std(artefact.diameter_uncertainty_mm),
            )
            return np.isfinite(pipe.deviation_mm), surface, np.array([0.0, 0.0, 0.0, 0.0, pipe.diameter_error_mm])
        case _:
            assert_never(artefact)
