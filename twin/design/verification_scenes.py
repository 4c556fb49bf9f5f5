"""Scenes for the verification of a sensor: target and step standard for calibration, plane standard for measurement.

All sizes and positions follow from the sensor, in its object coordinate system (OCS, mm). The stage moves the sensor
along Z, so that each image shows the object at another depth.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from twin.design.figures_of_merit import find_line_ends
from twin.design.sensor_arrays import extract_parameters
from twin.scene.description import Scene
from uwlts.errors import DesignError
from uwlts.model.library import validate_description
from uwlts.model.placement import camera_from_object, check_design
from uwlts.model.sensor import Camera, Exposure, Medium, Sensor, Volume
from uwlts.optics.design import Array, SheetGeometry, dot


@dataclass(frozen=True, eq=False)
class LineOfSight:
    """Camera of a sensor in a medium, with the pose ``T_camera_object`` (4, 4)."""

    camera: Camera
    geometry: SheetGeometry
    pose: np.ndarray

    @classmethod
    def from_sensor(cls, sensor: Sensor, medium: Medium) -> "LineOfSight":
        """Make it for a described sensor; DesignError if the sheet does not cross the camera's axis."""
        return cls(sensor.camera, SheetGeometry.from_description(sensor, medium), camera_from_object(sensor))

    def depth_mm(self, z: Array) -> Array:
        """Return the depth along the camera's axis, from the pupil, of points (0, 0, z) in the OCS."""
        return self.pose[2, 3] + self.pose[2, 2] * z

    def z_at(self, depth_mm: Array) -> Array:
        """Return Z in the OCS of points at depths along the camera's axis: the inverse of `depth_mm`."""
        return (depth_mm - self.pose[2, 3]) / self.pose[2, 2]

    def blur_px(self, depth_mm: Array) -> Array:
        """Return the diameter in px of the defocus blur of points in air."""
        camera = self.camera
        pupil = camera.focal_length_mm / camera.f_number
        return pupil * np.abs(1 / camera.focus_distance_mm - 1 / depth_mm) * camera.focal_length_px()

    def in_image(self, points: np.ndarray, *, margin_px: float = 0.0) -> np.ndarray:
        """Return a mask (N,) of the points (N, 3) inside the image, at least ``margin_px`` from its border."""
        camera, window = self.camera, self.geometry.window
        x, y, z = self.pose[:3, :3] @ points.T + self.pose[:3, 3:]
        # The formulas are valid only beyond the window's outer face.
        outside = (dot((x, y, z), window.normal) > window.outer_mm) & (z > 0)
        ahead = np.where(outside, x, 0), np.where(outside, y, 0), np.where(outside, z, 1e3)
        image, within = self.geometry.project(np, ahead), margin_px - 0.5
        in_width = (image.x >= within) & (image.x <= camera.width_px - 1 - within)
        return outside & in_width & (image.y >= within) & (image.y <= camera.height_px - 1 - within)

    def half_target_mm(self, z: float, y: float) -> np.ndarray:
        """Return half the sides (2,), X and Y, of a target about (0, y, z) that fills the view.

        Window and distortion are neglected. The size is limited to 1.25 times the view's diagonal, because it would be
        infinite at a grazing angle.
        """
        camera, rotation = self.camera, self.pose[:3, :3]
        side = np.linspace(-0.5, 0.5, 41)
        edge = np.concatenate([[(t, -0.5), (t, 0.5), (-0.5, t), (0.5, t)] for t in side])
        pixels = (edge + 0.5) * (camera.width_px - 1, camera.height_px - 1)
        slopes = (pixels - camera.principal_point()) / camera.focal_lengths_px()
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ rotation
        pupil = -rotation.T @ self.pose[:3, 3]
        length = np.full(len(rays), 1e6)
        np.divide(z - pupil[2], rays[:, 2], out=length, where=rays[:, 2] > 1e-6)
        hits = np.abs(pupil[:2] + length[:, None] * rays[:, :2] - (0.0, y))
        return np.minimum(hits.max(axis=0), 1.25 * self.depth_mm(z) * self.camera.corner_slope())


def find_longest_run(flags: np.ndarray | list[bool]) -> slice:
    """Return the slice of the longest run of true flags; empty if there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    start, end = max(edges.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
    return slice(start, end)


STANDARD_DEPTHS = 9  # positions of the plane standard in the volume
STEP_DEPTHS = 7  # positions of the step in the volume
TARGET_POSES = 9  # positions of the target in the volume

_DEPTHS_TRIED = 250  # finer than any limit of the volume needs to be known
_MARGIN = 0.03
"""Margin at either end of the depth range, relative to the range: there the stripe reaches the image's edge."""
_OVERSIZE = 1.2  # of a plane relative to the stripe, which must not end on it
_STEP_HEIGHT = 0.2
"""Height of the step relative to the depth range. A high step determines the window's distance more accurately."""
_EDGE = 0.02  # excluded width beside the step's edge, relative to the line's length
_NEARER = 0.75
"""Factor of the near depth for the target's range: without water and window, the same image rows are nearer."""
_FARTHER = 1.5  # factor of the far depth for the target's range
_CIRCLE_PX = 24.0  # diameter of the circles in the middle of the range
_SMALLEST_CIRCLE_PX = 12.0  # least diameter of the circles, at the far end of the range
_CIRCLE_BLURS = 2.5  # least diameter of the circles, relative to the diameter of the blur
_DOT = 0.4  # diameter of a marking dot relative to its circle
_LARGEST_BLUR_PX = 12.0
"""Largest diameter of the blur for circle detection, which searches edges within about 6 px on either side."""
_BORDER_PX = 4.0  # least distance of the target from the image's border


@dataclass(frozen=True)
class PlannedRecording:
    """Scene, the sensor that records it, and the name of the capture's file."""

    name: str
    sensor: Sensor
    scene: Scene


class Recordings(NamedTuple):
    """Recordings of a verification, sorted by number of images; without refraction, no step standard is needed."""

    target: PlannedRecording
    standard: PlannedRecording
    step: PlannedRecording | None


def plan_recordings(sensor: Sensor, medium: str, *, reflectance: float) -> Recordings:
    """Plan the scenes for the calibration of a sensor in one of its media, and a plane with a reflectance to measure.

    With refraction at a window, the target is recorded in air without the camera's window, and the step standard in the
    medium. Without refraction, only the target is recorded, under the conditions of use.

    Raises DescriptionError if the medium is unknown, or the reflectance is not from 0 to 1; DesignError if the sensor
    cannot work in the medium.
    """
    of_use = sensor.medium(medium)
    near, far = find_measured_range(sensor, of_use)
    sight = LineOfSight.from_sensor(sensor, of_use)
    # Middle in Y of the line at the near end, and a length that covers the line at the far end.
    at_near, (first, last) = find_line_ends(extract_parameters([sensor], [of_use]), np.array([near, far]))
    y = float(at_near.mean())
    length = 2 * _OVERSIZE * float(max(last - y, y - first))
    plane = {"kind": "plate", "position_mm": (0.0, y, 0.0), "reflectance": reflectance}
    plane |= {"width_mm": length, "height_mm": length}
    motion = _plan_travel(near, far, STANDARD_DEPTHS)
    scene = _make_scene("Plane standard", medium, motion=motion, objects=[plane], artefact={"kind": "plane"})
    standard = PlannedRecording("standard", sensor, scene)
    exposed = Exposure.model_validate(sensor.exposure.model_dump() | {"laser_ms": "auto", "lamp_ms": "auto"})
    calibrated = sensor.model_copy(update={"exposure": exposed})
    wavelength, media = sensor.laser.wavelength_nm, dict(sensor.media)
    if not (sensor.camera.window.mounted and of_use.refractive_index(wavelength) > 1 + 1e-6):
        return Recordings(_target(calibrated, medium, sight, near=near, far=far, y=y), standard, None)
    step = PlannedRecording("step", calibrated, _plan_step(medium, near=near, far=far, y=y, length=length))
    air = next(
        (name for name, one in media.items() if one.kind == "air" and one.refractive_index(wavelength) == 1), None
    )
    if air is None:
        air = "air" if "air" not in media else "air to calibrate in"
        media[air] = Medium(kind="air")
    in_air = calibrated.model_copy(update={"media": media})
    window = in_air.camera.window.model_copy(update={"mounted": False})
    camera = in_air.camera.model_copy(update={"window": window})
    bare = LineOfSight.from_sensor(in_air.model_copy(update={"camera": camera}), in_air.medium(air))
    return Recordings(_target(in_air, air, bare, near=near, far=far, y=y), standard, step)


def find_measured_range(sensor: Sensor, medium: Medium) -> tuple[float, float]:
    """Return the smallest and largest Z in mm, OCS, of the line in view within the measuring volume, with a margin.

    Raises DesignError as for `uwlts.model.placement.check_design`; or the laser points back towards the camera; or no
    part of the line in the volume is in view.
    """
    standoff = check_design(sensor, medium).standoff_mm
    volume, forward = sensor.volume, camera_from_object(sensor)[2, 2]
    if forward <= 0:
        raise DesignError(
            f"the angle between the laser's and the camera's axes is {math.degrees(math.acos(forward)):.0f} deg; it "
            "must be below 90 deg: turn the laser"
        )
    depths = (np.linspace(volume.near_mm, volume.far_mm, _DEPTHS_TRIED) - standoff) / forward
    lit = depths[find_longest_run(np.diff(find_line_ends(extract_parameters([sensor], [medium]), depths))[:, 0] > 0)]
    if len(lit) < 2:
        raise DesignError(
            f"the camera does not see the laser line in the volume from {volume.near_mm:g} to {volume.far_mm:g} mm: "
            "move the volume, increase fan_angle_deg, or turn the laser's fan towards the camera's view"
        )
    margin = _MARGIN * (lit[-1] - lit[0])
    return float(lit[0] + margin), float(lit[-1] - margin)


def _plan_step(medium: str, *, near: float, far: float, y: float, length: float) -> Scene:
    """Plan two blocks side by side along the line, with faces half a step in front of and behind the origin."""
    height = round(_STEP_HEIGHT * (far - near), 3)
    back = 1.5 * height
    blocks = [
        {
            "kind": "block",
            "size_mm": (length, length / 2, back - front),
            "position_mm": (0.0, y + side * length / 4, (front + back) / 2),
            "reflectance": 0.5,
        }
        for side, front in ((-1, height / 2), (1, -height / 2))
    ]
    return _make_scene(
        "Step standard",
        medium,
        motion=_plan_travel(near + height / 2, far - height / 2, STEP_DEPTHS),
        objects=blocks,
        artefact={"kind": "step", "height_mm": height, "edge_mm": _EDGE * length},
    )


def _plan_travel(near: float, far: float, count: int) -> dict[str, object]:
    """Return the motion through depths Z of the scene's origin, from far to near."""
    step = (far - near) / (count - 1)
    return {"start_mm": -far, "step_mm": step, "count": count, "direction": (0.0, 0.0, 1.0)}


def _make_scene(title: str, medium: str, **rest: object) -> Scene:
    return validate_description(Scene, {"title": title, "medium": medium} | rest, title)


def _target(sensor: Sensor, medium: str, sight: LineOfSight, *, near: float, far: float, y: float) -> PlannedRecording:
    """Plan a plate of circles normal to Z, moved through all depths with its three marks sharp and in view.

    The marks are near X = 0 and Y = ``y``. The stripe runs midway between two columns, on the plain background. Raises
    DesignError if the marks are sharp and in view at fewer than two depths.
    """
    depths = np.linspace(_NEARER * sight.depth_mm(near), _FARTHER * sight.depth_mm(far), _DEPTHS_TRIED)
    sharp = depths[find_longest_run(sight.blur_px(depths) <= _LARGEST_BLUR_PX)]
    # The size of the circles depends on the range, and the range with complete marks on their size. The circles must
    # be large enough in the image at all depths, under oblique view and out of focus.
    roughly = _find_marks_in_view(sight, sharp, 0.0, y)
    ends, aslant = roughly[[0, -1]], sight.pose[2, 2]
    least = np.maximum(_SMALLEST_CIRCLE_PX / aslant, _CIRCLE_BLURS * sight.blur_px(ends)) * ends
    usual = _CIRCLE_PX / aslant * math.sqrt(ends[0] * ends[1])
    diameter = round(float(max(usual, *least)) / sight.camera.focal_length_px(), 4)
    z = sight.z_at(_find_marks_in_view(sight, roughly, diameter, y))
    spacing = 2 * diameter
    columns, rows = (math.ceil(side / spacing) for side in sight.half_target_mm(z[-1], y))
    lattice = {
        "spacing_x_mm": spacing,
        "spacing_y_mm": spacing,
        "diameter_mm": diameter,
        "marker_diameter_mm": _DOT * diameter,
        "columns": 2 * columns + 1,
        "rows": 2 * rows + 1,
        "origin": (columns, rows),
        "marker_x": (1, 0),
        "marker_y": (0, 1),
    }
    plate = lattice | {
        "kind": "circle_plate",
        "width_mm": (2 * columns + 2) * spacing,
        "height_mm": (2 * rows + 2) * spacing,
        "position_mm": (-spacing / 2, y, 0.0),
        "reflectance": 0.25,
        "circle_reflectance": 0.8,
        "marker_reflectance": 0.03,
    }
    scene = _make_scene(
        "Circle target",
        medium,
        motion=_plan_travel(float(z[0]), float(z[-1]), TARGET_POSES) | {"lights": ("lamp", "laser")},
        objects=[plate],
        target={"kind": "circles"} | lattice,
        window_mounted=sight.camera.window.mounted,
    )
    # In air, the same image rows correspond to other depths, which the volume must contain.
    window = sensor.camera.window
    near, far = sight.depth_mm(z[[0, -1]]) - window.distance_mm - window.thickness_mm
    volume = Volume(near_mm=max(0.9 * near, 1e-3 * far), far_mm=1.1 * far)
    return PlannedRecording("target", sensor.model_copy(update={"volume": volume}), scene)


def _find_marks_in_view(sight: LineOfSight, depths: np.ndarray, diameter: float, y: float) -> np.ndarray:
    """Return the depths with all three marks completely in view; DesignError if there are fewer than two."""
    spacing = 2 * diameter
    centres = np.array([(-spacing / 2, y), (spacing / 2, y), (-spacing / 2, y + spacing)])
    rims = (centres[:, None] + diameter / 2 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])).reshape(-1, 2)

    def whole(depth: float) -> bool:
        points = np.column_stack([rims, np.full(len(rims), sight.z_at(depth))])
        return bool(sight.in_image(points, margin_px=_BORDER_PX + sight.blur_px(depth) / 2).all())

    seen = depths[find_longest_run([whole(depth) for depth in depths])]
    if len(seen) < 2:
        raise DesignError(
            f"a calibration target in air is nowhere in view and blurred by less than {_LARGEST_BLUR_PX:g} px: stop "
            f"down the lens (f_number {sight.camera.f_number:g}), focus it on the laser line (focus_distance_mm "
            f"{sight.camera.focus_distance_mm:g}), or change baseline, angle or focal length"
        )
    return seen
