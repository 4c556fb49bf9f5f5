"""Scenes for verifying a sensor: a target and a step standard to calibrate it, a plane standard to measure.

Everything is laid out for the sensor at hand, in its object coordinate system (OCS, mm); the stage moves the sensor
along Z, so that every image shows the same object at another depth.
"""

import math
from dataclasses import dataclass

import numpy as np

from twin.design.geometry import Array, Lens, WindowGeometry, dot, seen
from twin.scene.description import Scene
from uwlts.errors import DesignError
from uwlts.model.library import validated
from uwlts.model.placement import camera_from_object, check_design, laser_pose
from uwlts.model.sensor import Camera, Exposure, Medium, Sensor, Volume


@dataclass(frozen=True, eq=False)
class LineOfSight:
    """A sensor's camera and fan in a medium. ``pose`` is ``T_camera_object`` (4, 4), ``laser_mm`` (3,) the fan's origin
    in the OCS, ``fan_slope`` the tangent of half the fan's angle in the medium."""

    camera: Camera
    index: float
    window: WindowGeometry
    pose: np.ndarray
    laser_mm: np.ndarray
    fan_slope: float

    @classmethod
    def of(cls, sensor: Sensor, medium: Medium) -> "LineOfSight":
        """That of a sensor as described; DesignError where it has no stand-off."""
        wavelength = sensor.laser.wavelength_nm
        index, pose = medium.refractive_index(wavelength), camera_from_object(sensor)
        sine = math.sin(math.radians(sensor.laser.fan_angle_deg / 2)) / index
        laser_mm = (laser_pose(sensor).origin_mm - pose[:3, 3]) @ pose[:3, :3]
        window = WindowGeometry((0.0, 0.0, 1.0), 0.0, 0.0, 1.0, 1.0)
        if sensor.camera.window.mounted:
            window = WindowGeometry.of(sensor.camera.window, medium, wavelength, np.eye(3))
        return cls(sensor.camera, index, window, pose, laser_mm, sine / math.sqrt(1 - sine**2))

    def depth_mm(self, z: Array) -> Array:
        """Depth along the camera's axis, from its pupil, of points on the laser's axis through the stand-off."""
        return self.pose[2, 3] + self.pose[2, 2] * z

    def z_at(self, depth_mm: Array) -> Array:
        """Z of the points at such a depth."""
        return (depth_mm - self.pose[2, 3]) / self.pose[2, 2]

    def blur_px(self, depth_mm: Array) -> Array:
        """Diameter in px of the blur of a point in air: that of the pupil over the distance from the focused plane."""
        camera = self.camera
        pupil = camera.focal_length_mm / camera.f_number
        return pupil * np.abs(1 / camera.focus_distance_mm - 1 / depth_mm) * camera.focal_length_px()

    def in_image(self, points: np.ndarray, *, margin_px: float = 0.0) -> np.ndarray:
        """Which points (N, 3) appear in the image, at least so far within its border: (N,) bool."""
        camera, window = self.camera, self.window
        x, y, z = self.pose[:3, :3] @ points.T + self.pose[:3, 3:]
        # The formulas hold beyond the window's outer face only.
        outside = (dot((x, y, z), window.normal) > window.outer_mm) & (z > 0)
        ahead = np.where(outside, x, 0), np.where(outside, y, 0), np.where(outside, z, 1e3)
        image, within = seen(np, Lens.of(camera), window, ahead), margin_px - 0.5
        in_width = (image.x >= within) & (image.x <= camera.width_px - 1 - within)
        return outside & in_width & (image.y >= within) & (image.y <= camera.height_px - 1 - within)

    def line_mm(self, z: float) -> np.ndarray:
        """Y, closely spaced, where the fan lights what the camera sees at depth ``z``; possibly none."""
        reach = self.depth_mm(z) * self._diagonal_slope()
        middle = -self.pose[:3, 1] @ (self.pose[:3, 3] + self.pose[:3, 2] * z)
        y = np.linspace(middle - reach, middle + reach, 1001)
        visible = self.in_image(np.column_stack([np.zeros_like(y), y, np.full_like(y, z)]))
        lit = np.abs(y - self.laser_mm[1]) <= self.fan_slope * (z - self.laser_mm[2])
        return y[longest_run(visible & lit)]

    def half_target_mm(self, z: float, y: float) -> np.ndarray:
        """Half sides (2,), X and Y, of a target about (0, y, z) that fills the view, without window and distortion. At
        a grazing angle it would have to be endless: it goes beyond the view's diagonal by a quarter."""
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
        return np.minimum(hits.max(axis=0), 1.25 * self.depth_mm(z) * self._diagonal_slope() / 2)

    def _diagonal_slope(self) -> float:
        return 2 * self.camera.corner_slope()


def longest_run(flags: np.ndarray | list[bool]) -> slice:
    """Slice of the longest row of true flags; empty if there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    start, end = max(edges.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
    return slice(start, end)


STANDARD_DEPTHS = 9
STEP_DEPTHS = 7
TARGET_POSES = 9

_DEPTHS_TRIED = 250
_MARGIN = 0.03
"""Share of the depth range left out at either end: there the stripe runs into the image's edge."""
_OVERSIZE = 1.2
_STEP_HEIGHT = 0.2
"""Share of the depth range. A high step constrains the window's distance better than the scatter on its faces."""
_EDGE = 0.02
"""Share of the line's length beside the step's riser that is left out."""
_NEARER = 0.75
"""Without water and window the image rows of the volume lie at most so much nearer to the camera."""
_FARTHER = 1.5
"""The same for the farthest ones."""
_CIRCLE_PX = 24.0
"""Diameter of the circles in the middle of the range."""
_SMALLEST_CIRCLE_PX = 12.0
"""The least one at its far end."""
_CIRCLE_BLURS = 2.5
"""The least one in diameters of the blur."""
_DOT = 0.4
"""Diameter of a marking dot in diameters of its circle."""
_LARGEST_BLUR_PX = 12.0
"""Diameter of the blur up to which software finds circles: it looks for their edges some 6 px on either side."""
_BORDER_PX = 4.0


@dataclass(frozen=True)
class PlannedRecording:
    """A scene and the sensor that records it into a file of this name."""

    name: str
    sensor: Sensor
    scene: Scene


@dataclass(frozen=True)
class Recordings:
    """Captures recorded for a verification; a sensor without refraction to calibrate needs no step standard."""

    target: PlannedRecording
    step: PlannedRecording | None
    standard: PlannedRecording

    def all(self) -> list[PlannedRecording]:
        """The one with most images first."""
        return [recording for recording in (self.target, self.standard, self.step) if recording is not None]


def recordings(sensor: Sensor, medium: str, *, reflectance: float) -> Recordings:
    """Scenes that calibrate a sensor for one of its media, and the plane of a reflectance that it then measures.

    Behind a window in a medium denser than air, the target stands in air before the sensor without its window, and the
    step standard in the medium. Where light is not refracted, the target alone calibrates the sensor as it is used.

    DescriptionError where the sensor has no such medium or the reflectance is not from 0 to 1, DesignError where the
    sensor cannot work in it, with the reason and numbers.
    """
    of_use = sensor.medium(medium)
    near, far = measured_range(sensor, of_use)
    sight = LineOfSight.of(sensor, of_use)
    # The middle in Y of the line at the near end, and a length that covers it at the far end.
    at_near, at_far = sight.line_mm(near), sight.line_mm(far)
    y = float(at_near[0] + at_near[-1]) / 2
    length = 2 * _OVERSIZE * float(max(at_far[-1] - y, y - at_far[0]))
    plane = {"kind": "plate", "position_mm": (0.0, y, 0.0), "reflectance": reflectance}
    plane |= {"width_mm": length, "height_mm": length}
    motion = _travel(near, far, STANDARD_DEPTHS)
    scene = _scene("Plane standard", medium, motion=motion, objects=[plane], artefact={"kind": "plane"})
    standard = PlannedRecording("standard", sensor, scene)
    exposed = Exposure.model_validate(sensor.exposure.model_dump() | {"laser_ms": "auto", "lamp_ms": "auto"})
    calibrated = sensor.model_copy(update={"exposure": exposed})
    if not (sensor.camera.window.mounted and sight.index > 1 + 1e-6):
        return Recordings(_target(calibrated, medium, sight, near=near, far=far, y=y), None, standard)
    step = PlannedRecording("step", calibrated, _step(medium, near=near, far=far, y=y, length=length))
    wavelength, media = sensor.laser.wavelength_nm, dict(sensor.media)
    air = next(
        (name for name, one in media.items() if one.kind == "air" and one.refractive_index(wavelength) == 1), None
    )
    if air is None:
        air = "air" if "air" not in media else "air to calibrate in"
        media[air] = Medium(kind="air")
    in_air = calibrated.model_copy(update={"media": media})
    window = in_air.camera.window.model_copy(update={"mounted": False})
    camera = in_air.camera.model_copy(update={"window": window})
    bare = LineOfSight.of(in_air.model_copy(update={"camera": camera}), in_air.medium(air))
    return Recordings(_target(in_air, air, bare, near=near, far=far, y=y), step, standard)


def measured_range(sensor: Sensor, medium: Medium) -> tuple[float, float]:
    """Nearest and farthest Z in mm, OCS, in the measuring volume at which the camera sees the line, less a margin.

    DesignError as of `uwlts.model.placement.check_design`, and where the laser shines back towards the camera or the
    camera sees nothing of what the laser lights in the volume.
    """
    standoff = check_design(sensor, medium).standoff_mm
    sight, volume = LineOfSight.of(sensor, medium), sensor.volume
    forward = sight.pose[2, 2]
    if forward <= 0:
        raise DesignError(
            f"the laser's axis leans {math.degrees(math.acos(forward)):.0f} deg away from the camera's: the depth must "
            "grow along both; turn the laser"
        )
    depths = (np.linspace(volume.near_mm, volume.far_mm, _DEPTHS_TRIED) - standoff) / forward
    lit = depths[longest_run([len(sight.line_mm(z)) > 1 for z in depths])]
    if len(lit) < 2:
        raise DesignError(
            f"nowhere in the volume from {volume.near_mm:g} to {volume.far_mm:g} mm does the camera see what the laser "
            "lights: move the volume, widen fan_angle_deg, or turn the laser's fan towards the camera's view"
        )
    margin = _MARGIN * (lit[-1] - lit[0])
    return float(lit[0] + margin), float(lit[-1] - margin)


def _step(medium: str, *, near: float, far: float, y: float, length: float) -> Scene:
    """Two blocks side by side along the line, their faces half a step before and behind the scene's origin."""
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
    return _scene(
        "Step standard",
        medium,
        motion=_travel(near + height / 2, far - height / 2, STEP_DEPTHS),
        objects=blocks,
        artefact={"kind": "step", "height_mm": height, "edge_mm": _EDGE * length},
    )


def _travel(near: float, far: float, count: int) -> dict[str, object]:
    """Motion that brings the scene's origin to depths Z from far to near: the sensor approaches."""
    step = (far - near) / (count - 1)
    return {"start_mm": -far, "step_mm": step, "count": count, "direction": (0.0, 0.0, 1.0)}


def _scene(title: str, medium: str, **rest: object) -> Scene:
    return validated(Scene, {"title": title, "medium": medium} | rest, title)


def _target(sensor: Sensor, medium: str, sight: LineOfSight, *, near: float, far: float, y: float) -> PlannedRecording:
    """A plate of circles square to Z, moved through the depths about a range at which its three marks are well seen.

    The marks stand about X = 0 and Y = ``y``; the stripe runs midway between two columns, over a plain ground.
    DesignError where the marks are well seen at no two depths.
    """
    depths = np.linspace(_NEARER * sight.depth_mm(near), _FARTHER * sight.depth_mm(far), _DEPTHS_TRIED)
    sharp = depths[longest_run(sight.blur_px(depths) <= _LARGEST_BLUR_PX)]
    # The circles' size follows from the range, the range at which the marks are wholly in view from their size. Circles
    # are large enough in the image at all depths, seen from aslant and out of focus.
    roughly = _marks_in_view(sight, sharp, 0.0, y)
    ends, aslant = roughly[[0, -1]], sight.pose[2, 2]
    least = np.maximum(_SMALLEST_CIRCLE_PX / aslant, _CIRCLE_BLURS * sight.blur_px(ends)) * ends
    usual = _CIRCLE_PX / aslant * math.sqrt(ends[0] * ends[1])
    diameter = round(float(max(usual, *least)) / sight.camera.focal_length_px(), 4)
    z = sight.z_at(_marks_in_view(sight, roughly, diameter, y))
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
    scene = _scene(
        "Circle target",
        medium,
        motion=_travel(float(z[0]), float(z[-1]), TARGET_POSES) | {"lights": ("lamp", "laser")},
        objects=[plate],
        target={"kind": "circles"} | lattice,
        window_mounted=sight.camera.window.mounted,
    )
    # Air shows the image rows of the sensor's volume at other depths: the volume must hold those.
    window = sensor.camera.window
    near, far = sight.depth_mm(z[[0, -1]]) - window.distance_mm - window.thickness_mm
    volume = Volume(near_mm=max(0.9 * near, 1e-3 * far), far_mm=1.1 * far)
    return PlannedRecording("target", sensor.model_copy(update={"volume": volume}), scene)


def _marks_in_view(sight: LineOfSight, depths: np.ndarray, diameter: float, y: float) -> np.ndarray:
    """The camera's depths at which the three marks are wholly in view; DesignError where there are not two of them."""
    spacing = 2 * diameter
    centres = np.array([(-spacing / 2, y), (spacing / 2, y), (-spacing / 2, y + spacing)])
    rims = (centres[:, None] + diameter / 2 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])).reshape(-1, 2)

    def whole(depth: float) -> bool:
        points = np.column_stack([rims, np.full(len(rims), sight.z_at(depth))])
        return bool(sight.in_image(points, margin_px=_BORDER_PX + sight.blur_px(depth) / 2).all())

    seen = depths[longest_run([whole(depth) for depth in depths])]
    if len(seen) < 2:
        raise DesignError(
            f"a calibration target in air is nowhere in view and blurred by less than {_LARGEST_BLUR_PX:g} px: stop "
            f"down the lens (f_number {sight.camera.f_number:g}), focus it where the laser line is (focus_distance_mm "
            f"{sight.camera.focus_distance_mm:g}), or change baseline, angle or focal length"
        )
    return seen
