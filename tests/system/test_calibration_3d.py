"""Calibration of a 3D camera: images of the board under the lamp, centre lines of the laser, then a scan of spheres."""

from pathlib import Path

import numpy as np
import pytest

import uwlts
from twin.recording.record_scene import record_scene
from twin.rendering_options import Flaws, Options
from twin.scene.description import load_scene, replace_values
from uwlts.model.library import load_sensor
from uwlts.storage.capture import Capture
from uwlts.storage.truth import truth_path

POSES = {"direction": (0.0, 0.0, 1.0), "start_mm": -150.0, "step_mm": 60.0, "count": 6, "lights": ("lamp", "laser")}
PROFILES = {"start_mm": -18.0, "step_mm": 6.0, "count": 7}


@pytest.mark.slow
def test_centre_lines_on_the_board_calibrate_the_sensor_that_scans_spheres(tmp_path: Path):
    """A sensor whose lens is 1 % longer than its drawings say."""
    sensor, options = load_sensor("thesis-small"), Options(spp=4, flaws=Flaws(camera_3d=16))
    built = replace_values(sensor, camera={"focal_length_mm": 1.01 * sensor.camera.focal_length_mm})
    board = load_scene("target", motion=POSES)
    spheres = load_scene("spheres", placement="standoff", medium="air", motion=PROFILES)
    for name, scene in (("board", board), ("spheres", replace_values(spheres, window_mounted=False))):
        record_scene(scene, sensor, tmp_path / f"{name}.h5", as_built=built, options=options)
    with Capture(tmp_path / "board.h5") as capture:
        assert np.array_equal(capture.has_image, ~capture.laser_on) and capture.laser_on.sum() == POSES["count"]

    def spacing(calibration: uwlts.Calibration):
        cloud = uwlts.reconstruct(tmp_path / "spheres.h5", calibration)
        assert len(cloud) > 800
        return uwlts.evaluate(cloud, truth=truth_path(tmp_path / "spheres.h5")).sphere_spacings[0]

    found = spacing(uwlts.calibrate(air=[tmp_path / "board.h5"], joint=True))
    known = found.uncertainty
    assert known is not None
    # Five combined standard uncertainties, some 0.1 mm: false alarm 6e-7.
    assert abs(found.error_mm) < 5 * np.hypot(known.random_mm, known.systematic_mm) < 0.15
    # By the drawings alone the spacing is 1 % too large.
    assert abs(spacing(uwlts.nominal(sensor, medium="air")).error_mm) > 0.5
