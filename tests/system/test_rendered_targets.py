"""Rendered images of the target, out of focus and inclined: circles are found where they are."""

import cv2
import numpy as np
import pytest

import twin
from uwlts.model.library import load_sensor
from uwlts.targets import parse_target

FRAMES = range(0, 62, 8)  # lamp images, from the farthest to the nearest
RIM = np.linspace(0, 2 * np.pi, 24, endpoint=False)
P1, FOCAL_PX = 1e-5, 0.06
"""Twice the largest p1 of five seeds, a fiftieth of what is known of it before; 2.5e-5 of the focal length."""


def seen(points, pose, matrix, distortion):
    """Centroids (N, 2) of the images of circles of 5 mm about points (N, 3), by OpenCV's pinhole."""
    circle = 2.5 * np.column_stack([np.cos(RIM), np.sin(RIM), 0 * RIM])
    rim = (points[:, None] + circle).reshape(-1, 3)
    x, y = np.moveaxis(
        cv2.projectPoints(rim, pose[:3], pose[3:], matrix, distortion)[0].reshape(len(points), -1, 2), 2, 0
    )
    cross = x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y
    return np.stack([((a + np.roll(a, -1, 1)) * cross).sum(1) for a in (x, y)], 1) / (3 * cross.sum(1))[:, None]


@pytest.mark.slow
def test_circles_out_of_focus_are_found_where_they_are():
    sensor = load_sensor("thesis-as-built")
    recording = twin.render("target", sensor=sensor, frames=[*FRAMES])
    target, camera = parse_target(recording.scene.target), sensor.camera
    matrix = np.diag([camera.focal_length_px(), camera.focal_length_px(), 1.0])
    matrix[:2, 2] = camera.principal_point()
    d = camera.distortion
    distortion = np.array(list(d.model_dump().values()))
    products, squares = np.zeros(2), np.zeros(2)
    for image in recording.images:
        view = target.detect(image)
        points = np.column_stack([view.points_mm[:, :2], np.zeros(len(view.points_mm))])
        _, turn, shift = cv2.solvePnP(points, view.pixels, matrix, distortion)

        pose = np.concatenate([turn.ravel(), shift.ravel()])

        def image_of(moved, points=points, pose=pose):
            """Pixels for a change of pose (6,), p1 and focal length."""
            wider = matrix + np.diag([moved[7], moved[7], 0.0])
            return seen(points, pose + moved[:6], wider, distortion + moved[6] * np.eye(8)[2]).ravel()

        steps = np.diag([1e-4] * 6 + [1e-5, 0.1])
        by_all = np.stack([image_of(step) - image_of(-step) for step in steps], axis=1) / (2 * steps.sum(axis=1))
        off = view.pixels.ravel() - image_of(np.zeros(8))
        good = np.abs(off) < 0.1
        of_pose = np.linalg.qr(by_all[good, :6])[0]
        by_model, off = (each - of_pose @ (of_pose.T @ each) for each in (by_all[good, 6:], off[good]))
        products += by_model.T @ off
        squares += (by_model**2).sum(axis=0)
    # Apparent change of a camera if p1 or the focal length alone is estimated, every image with its own pose.
    assert np.all(np.abs(products / squares) < (P1, FOCAL_PX))
