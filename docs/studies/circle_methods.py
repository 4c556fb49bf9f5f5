"""Errors of the centres of the target's circles: the thesis's processing and `uwlts.targets`."""

import math

import cv2
import numpy as np
from result_tables import table
from scipy.spatial import cKDTree

from twin.rendering_options import Options
from twin.scene.description import CirclePlate, load_scene
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.targets.detection import find_circles

STAGE_MM = {"near": 85.0, "middle": -20.0, "far": -130.0}
NEIGHBOURHOOD_PX = 65
"""Window of the background correction, some circles wide."""
SMALLEST_PX, MARGIN_PX = 30, 6
RIM_POINTS, NEAREST_PX = 720, 3.0


def circles_table() -> str:
    """Return the errors of the centres, px, by method and place; circles are counted where one is not found."""
    from twin.recording.sensor_simulator import SensorSimulator

    sensor, rows = load_sensor("thesis"), dict[str, list[str]]()
    for stage in STAGE_MM.values():
        along = {"direction": (0.0, 0.0, 1.0), "start_mm": stage, "count": 1, "lights": ("lamp",)}
        scene = load_scene("target", motion=along)
        studio = SensorSimulator(sensor, scene, Options(spp=64))
        image = studio.frame(next(scene.motion.shots()), 0).image
        truth = _true_images(sensor, scene.objects[0], stage)
        methods = {
            "thesis's processing": ellipses_of_contours(image),
            "uwlts.targets": next(find_circles(image)).centres,
        }
        errors = {method: _errors(centres, truth) for method, centres in methods.items()}
        both = np.isfinite(np.stack(list(errors.values()))).all(axis=(0, 2))
        for method, error in errors.items():
            found = int(np.isfinite(error[:, 0]).sum())
            largest = np.linalg.norm(error[both], axis=1).max()
            rms = math.sqrt((error[both] ** 2).sum(axis=1).mean())
            counted = "" if found == len(truth) else f", {found} of {len(truth)}"
            rows.setdefault(method, []).append(f"{rms:.3f} ({largest:.3f}){counted}")
    return table(["rms (largest) px", *STAGE_MM], [[method, *cells] for method, cells in rows.items()])


def ellipses_of_contours(image: np.ndarray) -> np.ndarray:
    """Return centres (N, 2) found with the steps of the thesis (section 4.5), by OpenCV.

    Steps: median filter of 5 x 5, subtraction of the background, and Otsu's threshold. Then holes are filled, small
    particles and those on the border removed, and an ellipse is fitted to each particle's outline.
    """
    calm = cv2.medianBlur(image, 5).astype(np.float32)
    size = (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)
    level = cv2.normalize(calm - cv2.blur(calm, size), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    _, mask = cv2.threshold(level, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    height, width = image.shape
    centres = []
    for outline in outlines:
        x, y, w, h = cv2.boundingRect(outline)
        inside = x > 0 and y > 0 and x + w < width and y + h < height
        if inside and cv2.contourArea(outline) >= SMALLEST_PX and len(outline) >= 5:
            centres.append(cv2.fitEllipse(outline)[0])
    return np.array(centres, float).reshape(-1, 2)


def _errors(centres: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the nearest centre minus each true centre (T, 2), NaN if no centre is near."""
    distance, index = cKDTree(centres).query(truth)
    return np.where((distance < NEAREST_PX)[:, None], centres[index] - truth, np.nan)


def _true_images(sensor: Sensor, plate: CirclePlate, stage_mm: float) -> np.ndarray:
    """Return centroids (T, 2) of the images of all circles completely in view, px.

    The camera is a pinhole in air, calculated from the sensor's baseline and angle. The image of a circle is an
    ellipse, and its centroid is the ellipse's centre.
    """
    camera, angle = sensor.camera, math.radians(sensor.laser.triangulation_angle_deg)
    axis = np.array([0.0, math.sin(angle), math.cos(angle)])
    frame = np.stack([np.array([0.0, -math.cos(angle), math.sin(angle)]), np.array([1.0, 0.0, 0.0]), axis])
    standoff = np.array([0.0, 0.0, sensor.laser.baseline_mm / math.tan(angle)])
    column, row = (g.ravel() for g in np.meshgrid(np.arange(plate.columns), np.arange(plate.rows)))
    pitch = plate.spacing_x_mm, plate.spacing_y_mm
    middle = np.stack([(column - plate.origin[0]) * pitch[0], (row - plate.origin[1]) * pitch[1]], axis=1)
    turn = 2 * math.pi * np.arange(RIM_POINTS) / RIM_POINTS
    rim = middle[:, None] + plate.diameter_mm / 2 * np.stack([np.cos(turn), np.sin(turn)], axis=1)

    def seen(flat: np.ndarray) -> np.ndarray:
        depth = np.full((*flat.shape[:-1], 1), -stage_mm)
        point = np.concatenate([flat, depth], axis=-1) @ frame + standoff
        return camera.focal_length_px() * point[..., :2] / point[..., 2:] + camera.principal_point()

    outline = seen(rim)
    x, y = outline[..., 0], outline[..., 1]
    cross = x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y
    centroid = np.stack([((v + np.roll(v, -1, axis=1)) * cross).sum(axis=1) for v in (x, y)], axis=1)
    centroid /= 3 * cross.sum(axis=1)[:, None]
    limits = np.array([camera.width_px, camera.height_px]) - 1 - MARGIN_PX
    whole = ((outline > MARGIN_PX) & (outline < limits)).all(axis=(1, 2))
    return centroid[whole]
