"""Complete calibration from captures of drawn images: circles, stripes on the plate, and stripes on a step."""

import json

import cv2
import numpy as np
import pytest

from tests.uwlts.calibration_views import (
    WATER,
    lattice,
    lens_of,
    stage_images,
    step_profile,
    stripes_on_target,
    through_window,
)
from tests.uwlts.drawn_stripes import coarse_sensor, stripe_image
from uwlts.calibration.calibrate import calibrate
from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, calibrate_sequentially
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Medium
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter

POSITIONS = np.arange(5) * 40.0
PLATE = {"kind": "circles", "diameter_mm": 6.0, "marker_diameter_mm": 2.5, "columns": 17, "rows": 17, "origin": (8, 8)}


SENSOR = coarse_sensor(window_mounted=False)
SHAPE = (SENSOR.camera.height_px, SENSOR.camera.width_px)


def plate_image(pose, rng):
    """Bright circles on a dark plate, three of them with a dark dot."""
    lens, steps = lens_of(SENSOR), (np.arange(3) - 1) / 3
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    bright = np.zeros(SHAPE)
    for dv in steps:
        for du in steps:
            rays = np.stack([(u + du - lens.cx) / lens.fx, (v + dv - lens.cy) / lens.fy, np.ones(SHAPE)], axis=-1)
            points = rays * (pose[:3, 2] @ pose[:3, 3] / (rays @ pose[:3, 2]))[..., None] - pose[:3, 3]
            x, y = np.moveaxis(points @ pose[:3, :2], -1, 0)
            i, j = np.rint(x / 9.375), np.rint(y / 9.372)
            radius = np.hypot(x - 9.375 * i, y - 9.372 * j)
            dotted = np.isin(i + 100 * j, (0, 2, 200)) & (radius < 1.25)
            bright += (radius < 3.0) & ~dotted & (np.maximum(abs(i), abs(j)) <= 8)
    image = cv2.GaussianBlur(25 + 180 * bright / 9, (0, 0), 0.7) + rng.normal(0, 1, SHAPE)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def write(path, *, frames, sensor=SENSOR, medium="air", **header):
    header = CaptureHeader(
        name=path.stem,
        sensor=sensor,
        medium_name=medium,
        saturation_dn=255,
        stage_direction=(0.0, 0.0, 1.0),
        medium=Medium(kind="air") if medium == "air" else Medium(kind="custom", index=WATER),
    ).model_copy(update=header)
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for image, stage, laser in frames:
            writer.append(Frame(image, float(stage), laser, 1.0, 0.0))
    return path


@pytest.fixture(scope="module")
def air_frames():
    rng = np.random.default_rng(1)
    _, poses, _ = stage_images(SENSOR, positions=POSITIONS, points=lattice(17, 17))
    lamps = [(plate_image(pose, rng), stage, False) for pose, stage in zip(poses, POSITIONS, strict=True)]
    stripes = stripes_on_target(SENSOR, poses)
    return lamps + [
        (stripe_image([pixels], rng), stage, True) for pixels, stage in zip(stripes, POSITIONS, strict=True)
    ]


@pytest.fixture(scope="module")
def files(air_frames, tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("captures"), np.random.default_rng(2)
    blank = np.full(SHAPE, 20, dtype=np.uint8)
    strangers = [(blank, 500.0, False), (air_frames[-1][0], 500.0, True), (blank, POSITIONS[0], True)]
    wet = SENSOR.camera.window.model_copy(update={"mounted": True, "distance_mm": 60.0})
    sensor = SENSOR.model_copy(update={"camera": SENSOR.camera.model_copy(update={"window": wet})})
    steps = []
    for depth, tilt in ((-40.0, 0.01), (10.0, -0.02), (60.0, 0.0)):
        points = step_profile(depth, tilt=tilt)
        block = np.abs(points[:, 1]) < 30.5
        edges = np.flatnonzero(np.diff(block.astype(int))) + 1
        pieces = np.split(points, edges)
        views = [through_window(SENSOR, piece) for piece in pieces]
        steps.append((stripe_image([views[0], views[2], views[1]], rng), 0.0, True))
    steps.append((blank, 0.0, True))
    return (
        write(folder / "air.h5", frames=air_frames + strangers, target=PLATE),
        write(
            folder / "steps.h5",
            frames=steps,
            sensor=sensor,
            medium="water",
            artefact={"kind": "step", "height_mm": 23.17},
        ),
    )


@pytest.fixture(scope="module")
def result(files):
    told = []
    with Capture(files[0]) as air, Capture(files[1]) as steps:
        made = calibrate_sequentially([air], [steps], progress=lambda *what: told.append(what))
        assert told[len(air) - 1] == (len(air), len(air), "target")
        assert told[-1] == (len(steps), len(steps), "step")
        assert len(told) == len(air) + len(steps)
    return made


def test_the_sensor_is_found(result):
    camera, lens = result.calibration.camera, lens_of(SENSOR)
    # Centres of drawn circles are good to 0.01 px a coordinate; by the reported covariance, f and c then to 0.02 px.
    assert result.camera.rms_px() < 0.03
    assert camera.fx_px == pytest.approx(lens.fx, abs=0.1)
    assert (camera.cx_px, camera.cy_px) == (pytest.approx(lens.cx, abs=0.1), pytest.approx(lens.cy, abs=0.1))
    # One pixel is 0.3 mm at the target; stripes are good to 0.01 px.
    laser = laser_pose(SENSOR)
    assert np.array(result.calibration.sheet.normal) @ laser.normal > np.cos(1e-4)
    assert result.calibration.sheet.offset_mm == pytest.approx(laser.normal @ laser.origin_mm, abs=0.02)
    np.testing.assert_allclose(result.calibration.object_transform(), camera_from_object(SENSOR), atol=0.03)
    assert result.sheet.rms_mm < 0.01
    # Height errors of 0.001 mm count 48-fold.
    assert np.abs(result.window.errors_mm).max() < 0.003
    assert result.calibration.window.distance_mm == pytest.approx(SENSOR.camera.window.distance_mm, abs=0.2)


def test_circle_offsets_are_taken_out(result, files):
    assert 0.005 < max(np.abs(bias).max() for bias in result.camera.bias_px) < 0.5
    with Capture(files[0]) as air:
        plain = calibrate_sequentially([air], options=CalibrationOptions(correct_circles=False))
    assert plain.camera.bias_px is None
    assert plain.calibration.window is None
    assert plain.window is None
    assert "window" not in plain.calibration.residuals


def test_images_left_out_are_reported(result):
    told = "\n".join(result.warnings)
    assert "frame 10: left out" in told
    assert "frame 11: stripe left out, no target was found at 500 mm" in told
    assert "frame 12: stripe left out, found on 0 lines" in told
    assert "steps.h5, frame 3: stripe left out" in told
    assert len(result.warnings) == 4
    assert result.air.frames == [(0, n) for n in range(5)]
    assert [step.source for step in result.steps] == [f"steps.h5, frame {n}" for n in range(3)]


def test_the_file_keeps_the_figures(result, tmp_path):
    result.calibration.save(tmp_path / "sensor.json")
    kept = load_calibration(tmp_path / "sensor.json")
    assert kept == result.calibration.model_validate(json.loads(result.calibration.model_dump_json()))
    assert kept.residuals["camera"]["rms_px"] == result.camera.rms_px()
    assert kept.residuals["window"]["distance_mm"] == kept.window.distance_mm
    std = kept.std()
    found = result.camera.std()
    assert (std.fx_px, std.fy_px, std.cx_px, std.cy_px) == (found["f"], found["f"], found["cx"], found["cy"])
    assert std.distortion == {name: found[name] for name in std.distortion} and len(std.distortion) == len(found) - 3
    assert std.window_distance_mm == result.window.uncertainty_mm
    assert std.sheet_normal_deg == np.degrees(result.sheet.normal_std_rad)
    assert len(kept.residuals["window"]["curve_mm"]) == len(result.window.curve_mm)
    assert kept.provenance["warnings"] == result.warnings
    assert kept.provenance["step_captures"][0]["medium"] == "water"


def test_one_refraction_and_free_directions(files):
    options = CalibrationOptions(refractions=1, poses="stage", camera=CameraOptions(distortion=()))
    with Capture(files[0]) as air, Capture(files[1]) as steps:
        result = calibrate_sequentially([air], [steps], options=options)
    assert result.calibration.window.refractions == 1
    assert any("one interface" in warning for warning in result.warnings)
    # Paraxial rays leave the outer face of a plate as from one interface at d + t (1/g - 1/n) / (1 - 1/n).
    plate = SENSOR.camera.window
    shift = plate.thickness_mm * (1 / plate.index(635.0) - 1 / WATER) / (1 - 1 / WATER)
    assert shift < -2
    assert result.calibration.window.distance_mm == pytest.approx(plate.distance_mm + shift, abs=0.3)
    assert result.camera.stage_tilt_rad < 1e-3


def test_contradictory_captures_are_refused(files, air_frames, tmp_path):
    def run(path, steps=(), **options):
        with Capture(path) as air:
            return calibrate_sequentially([air], steps, options=CalibrationOptions(**options))

    with pytest.raises(CalibrationError, match="no capture"):
        calibrate_sequentially([])
    with Capture(files[0]) as air, pytest.raises(CalibrationError, match=r"air\.h5 and air\.h5 are the same capture"):
        calibrate_sequentially([air, air])
    with pytest.raises(DescriptionError, match="says that it was taken in air"):
        calibrate(water=[files[0]])
    with pytest.raises(CalibrationError, match="describe its target"):
        run(write(tmp_path / "untold.h5", frames=air_frames[:1]))
    with pytest.raises(CalibrationError, match="found in no image"):
        run(write(tmp_path / "dark.h5", frames=[(np.zeros(SHAPE, np.uint8), 0.0, False)], target=PLATE))
    sideways = write(tmp_path / "sideways.h5", frames=air_frames[:2], target=PLATE, stage_direction=(1.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match="along the laser's axis"):
        run(sideways)
    away = write(tmp_path / "away.h5", frames=air_frames[:3], target=PLATE, stage_direction=(0.0, 0.0, -1.0))
    with pytest.raises(CalibrationError, match="mirrored relative to the stage"):
        run(away)
    with pytest.raises(CalibrationError, match="no image with the laser on"):
        run(write(tmp_path / "lamps.h5", frames=air_frames[:5], target=PLATE))
    bare = write(tmp_path / "bare.h5", frames=air_frames[-1:])
    with Capture(bare) as no_step, pytest.raises(CalibrationError, match="no window"):
        run(files[0], [no_step])
    wet = SENSOR.camera.window.model_copy(update={"mounted": True})
    sensor = SENSOR.model_copy(update={"camera": SENSOR.camera.model_copy(update={"window": wet})})
    no_height = write(tmp_path / "step.h5", frames=air_frames[-1:], sensor=sensor, artefact={"kind": "step"})
    with Capture(no_height) as step, pytest.raises(DescriptionError, match="height_mm"):
        run(files[0], [step])
    flat = write(tmp_path / "flat.h5", frames=air_frames[-1:], sensor=sensor, artefact={"kind": "step", "height_mm": 9})
    with Capture(flat) as step, pytest.raises(CalibrationError, match="no step image can be used"):
        run(files[0], [step])
    turned = sensor.model_copy(update={"camera": sensor.camera.model_copy(update={"stripe_along": "height"})})
    other = write(tmp_path / "other.h5", frames=air_frames[-1:], sensor=turned)
    with (
        Capture(other) as step,
        pytest.raises(CalibrationError, match="other.h5 does not fit air.h5: its stripe_along"),
    ):
        run(files[0], [step])
