"""Images with the flaws of real ones: correct parameters of lens and pixels, and correct stripes."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation

import twin
import uwlts
from tests.virtual_sensors import altered, cropped, plate, scene_of
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import Flaws, Options
from twin.scene.platforms import Shot
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor
from uwlts.stripe import extract_stripe

TARGET = {"kind": "chessboard", "columns": 15, "rows": 8, "square_mm": 11.0}
MIDDLE_MM = (77.0, 38.5)
VIEWS = (
    # rotation in deg, place of the board's middle in mm in the camera frame; most boards are cut off by the image
    ((0, 0, 0), (0, 0, 330)),
    ((30, 0, 5), (-10, 15, 320)),
    ((-30, 0, -5), (10, -15, 320)),
    ((0, 30, 0), (0, 20, 320)),
    ((0, -30, 3), (0, -20, 320)),
    ((20, 15, 90), (-20, 30, 330)),
    ((-20, -15, -90), (25, -30, 330)),
    ((15, -20, 180), (30, 30, 310)),
    ((-20, 15, 0), (-30, -30, 310)),
    ((20, 20, -3), (30, -25, 310)),
    ((-15, -20, 170), (-30, 25, 310)),
    ((-30, 25, 45), (0, 0, 340)),
)
STRIPE_LINES, BLOCK_LINES = 640, 16
COLOUR_SHIFT_PX = 0.02
"""Red of every second row, interpolated, then averaged over pairs of rows by the compression, leaves a stripe lopsided:
its peak is 0.02 px lower, its centre of mass where it was, as for a stripe drawn without noise at any quality."""


class Tripod(SensorSimulator):
    """Simulator that rotates the sensor in front of the board instead of moving it by a stage."""

    def pose(self, shot: Shot) -> np.ndarray:
        rotation, place = VIEWS[round(shot.stage_mm)]
        camera_from_board = np.eye(4)
        camera_from_board[:3, :3] = Rotation.from_euler("xyz", rotation, degrees=True).as_matrix()
        camera_from_board[:3, 3] = place
        return np.linalg.inv(camera_from_board) @ camera_from_object(self.sensor)


def photographed(sensor: Sensor, folder: Path, *effects: str) -> Sensor:
    """Photographs of the board in all views, in a folder with its description; returns the camera as built."""
    board = {"kind": "target_plate", "target": TARGET, "reflectance": 0.8}
    scene = scene_of(
        board | {"position_mm": (-MIDDLE_MM[0], -MIDDLE_MM[1], 0.0)},
        medium="air",
        window_mounted=False,
        motion={"lights": ("lamp",), "count": len(VIEWS)},
    )
    studio = Tripod(sensor, scene, Options(flaws=Flaws.parse(*effects)))
    for number, shot in enumerate(scene.motion.shots()):
        assert cv2.imwrite(str(folder / f"board{number}.png"), studio.frame(shot, number).image)
    (folder / "target.toml").write_text(tomli_w.dumps(TARGET))
    return studio.sensor


@pytest.mark.slow
def test_pixels_and_tangential_distortion_are_found_in_flawed_photographs(thesis_as_built, tmp_path):
    size = {"width_px": 640, "height_px": 512, "pixel_size_um": 10.6, "principal_point_px": (323.6, 252.5)}
    sensor = altered(thesis_as_built, {"camera": size, "exposure": {"lamp_ms": 0.6}})
    flaws = "vignetting", "uneven-lamp", "glare", "jpeg", "colour-filter"
    camera = photographed(sensor, tmp_path, "pixel-aspect=1.002", "tangential=0.001", *flaws).camera
    found = uwlts.calibrate_camera(tmp_path)
    assert not found.warnings, "every image is used"
    corners = [len(photograph.pixels) for photograph in found.photographs]
    assert sum(count < 15 * 8 for count in corners) >= 8, "boards are cut off"
    values, std = found.lens.values(), found.lens.std()
    assert {"fx", "fy", "p1"} <= values.keys(), f"the lens is taken for one of {found.lens.options.name}"
    (fx, fy), (cx, cy) = camera.focal_lengths_px(), camera.principal_point()
    true = {"fx": fx, "fy": fy, "cx": cx, "cy": cy} | camera.distortion.model_dump()
    off = {name: (values[name] - true[name]) / std[name] for name in values}
    assert max(np.abs([*off.values()])) < 4, off
    # The uncertainties are small enough to distinguish the flaws from zero.
    assert abs(values["p1"]) > 4 * std["p1"]
    aspect = found.lens.solution.model.fy_px / found.lens.solution.model.fx_px
    assert abs(aspect - 1.002) < 2e-4


def test_the_stripe_is_found_in_flawed_images_where_it_truly_is(thesis):
    sensor = cropped(thesis, STRIPE_LINES, 512)
    # A turned plate: the stripe crosses rows at all phases of filters and compression.
    scene = scene_of(plate() | {"rotation_deg": (20.0, 0.0, 0.0)})
    recording = twin.render(scene, sensor=sensor, effects=("glare", "jpeg", "colour-filter", "lamp-and-laser"))
    stripe = extract_stripe(recording.images[0], stripe_along="width", saturation=255)
    true = recording.truth.centre_px[0]
    assert np.isfinite(true).all() and np.ptp(true) > 20
    off = stripe.centre_px - true
    assert np.isfinite(off).mean() >= 0.95
    # Errors due to speckle and compression are correlated between neighbouring lines, but not between blocks of 16: the
    # mean of 40 blocks exceeds four of its standard errors once in 4,000 times (Student's t).
    blocks = np.nanmean(off.reshape(-1, BLOCK_LINES), axis=1)
    assert abs(blocks.mean() - COLOUR_SHIFT_PX) < 4 * blocks.std(ddof=1) / np.sqrt(len(blocks))
    # Speckle leaves 0.11 px, filters and compression 0.17; no line follows the plate's light or the edge of a block.
    assert np.nanmax(np.abs(off)) < 6 * np.nanstd(off) < 6 * 0.25
