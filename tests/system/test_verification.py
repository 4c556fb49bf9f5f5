"""Verification of designs by rendering: layout for unlike sensors, the comparison with the plane, and one whole run."""

import json

import cv2
import numpy as np
import pytest

from tests.virtual_sensors import altered, image_of
from twin.design.verification import _evaluate_points, _run, verify
from twin.design.verification_scenes import (
    STANDARD_DEPTHS,
    STEP_DEPTHS,
    TARGET_POSES,
    find_measured_range,
    plan_recordings,
)
from twin.scene.description import Scene
from uwlts.errors import CalibrationError, DescriptionError, DesignError, EvaluationError
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor

pytestmark = pytest.mark.slow

CLOSE = {
    "camera": {"focal_length_mm": 8.0, "focus_distance_mm": 220.0, "window": {"aperture_diameter_mm": 80.0}},
    "laser": {"baseline_mm": 154.0, "waist_distance_mm": 268.0},
    "volume": {"near_mm": 90.0, "far_mm": 240.0},
}
SLENDER = {
    "camera": {"focus_distance_mm": 346.0},
    "laser": {"baseline_mm": 200.0, "triangulation_angle_deg": 30.0, "waist_distance_mm": 400.0},
    "volume": {"near_mm": 180.0, "far_mm": 400.0},
}
DESIGNS = {
    "thesis": {},
    "slender": SLENDER,
    "close": CLOSE,
    "height": {"camera": {"stripe_along": "height"}},
    "distorted": {"camera": {"distortion": {"k1": -0.2, "k2": 0.1}, "principal_point_px": (600.0, 560.0)}},
    "many pixels": {
        "camera": {"width_px": 2448, "height_px": 2048, "pixel_size_um": 3.45, "focal_length_mm": 16.0},
        "detector": {"bits": 12},
    },
    "few pixels": {"camera": {"width_px": 640, "height_px": 480, "pixel_size_um": 6.0}},
}


@pytest.fixture(params=DESIGNS)
def design(request: pytest.FixtureRequest, thesis: Sensor) -> Sensor:
    """One of several unlike sensors."""
    return altered(thesis, DESIGNS[request.param])


@pytest.fixture(params=[name for name in DESIGNS if name != "distorted"])
def pinhole(request: pytest.FixtureRequest, thesis: Sensor) -> Sensor:
    """One of the sensors without distortion, which the oracle does not model."""
    return altered(thesis, DESIGNS[request.param])


def origins(scene: Scene) -> np.ndarray:
    """Z (K,) in the OCS of the scene's origin at each position of the sensor."""
    motion = scene.motion
    return -(motion.start_mm + motion.step_mm * np.arange(motion.count))


def pixels_in_air(sensor: Sensor, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3), OCS, without the window."""
    camera, pose = sensor.camera, camera_from_object(sensor)
    focal, (cx, cy), d = camera.focal_length_px(), camera.principal_point(), camera.distortion
    matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    rotation, shift = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
    return cv2.projectPoints(points, rotation, shift, matrix, np.array(list(d.model_dump().values())))[0][:, 0]


# --- layout -----------------------------------------------------------------------------------------------------------


def test_the_marks_are_in_view_at_every_pose_of_the_target(design):
    target = plan_recordings(design, "water", reflectance=0.5).target
    plate, lattice = target.scene.objects[0], target.scene.target
    assert target.sensor.medium(target.scene.medium).kind == "air" and not target.scene.window_mounted
    steps = np.array([(0, 0), lattice["marker_x"], lattice["marker_y"]])
    offsets = np.array(plate.position_mm)[:2] + steps * (plate.spacing_x_mm, plate.spacing_y_mm)
    # The software leaves out circles that touch the image's border.
    radius = plate.diameter_mm / 2
    rims = np.vstack([offsets + radius * np.array(side) for side in ((1, 0), (-1, 0), (0, 1), (0, -1))])
    depths = origins(target.scene)
    assert len(depths) == TARGET_POSES and rims.shape == (12, 2)
    for z in depths:
        seen = pixels_in_air(design, np.column_stack([rims, np.full(12, z)]))
        assert (seen > 1).all() and (seen < (design.camera.width_px - 2, design.camera.height_px - 2)).all()


def test_circles_are_neither_too_small_nor_out_of_proportion(design):
    target = plan_recordings(design, "water", reflectance=0.5).target
    plate, pose, camera = target.scene.objects[0], camera_from_object(design), design.camera
    depths = pose[2, 3] + pose[2, 2] * origins(target.scene)
    size_px = plate.diameter_mm * camera.focal_length_px() / depths
    assert depths.max() > 1.1 * depths.min()
    assert (size_px * pose[2, 2] >= 12.0 - 1e-2).all()  # diameter_mm is rounded to 0.1 um
    # At least five circles of two diameters each must fit along the image's shorter side.
    assert (size_px <= min(camera.width_px, camera.height_px) / 10).all()


def test_standards_stay_in_the_measuring_volume(design):
    planned = plan_recordings(design, "water", reflectance=0.3)
    standard, step = planned.standard.scene, planned.step.scene
    near, far = find_measured_range(design, design.medium("water"))
    window = design.camera.window
    pose = camera_from_object(design)
    outside = pose[2, 3] + pose[2, 2] * np.array([near, far]) - window.distance_mm - window.thickness_mm
    assert design.volume.near_mm < outside[0] < outside[1] < design.volume.far_mm
    depths = origins(standard)
    assert len(depths) == STANDARD_DEPTHS and depths[0] == pytest.approx(far) and depths[-1] == pytest.approx(near)
    assert standard.objects[0].reflectance == 0.3
    height = step.artefact["height_mm"]
    assert len(origins(step)) == STEP_DEPTHS
    assert origins(step).max() + height / 2 == pytest.approx(far)
    assert origins(step).min() - height / 2 == pytest.approx(near)
    faces = [thing.position_mm[2] - thing.size_mm[2] / 2 for thing in step.objects]
    assert faces[0] - faces[1] == pytest.approx(height)


def test_the_line_is_in_view_at_both_ends_and_the_plate_holds_it(pinhole):
    water, camera = pinhole.medium("water"), pinhole.camera
    plate = plan_recordings(pinhole, "water", reflectance=0.5).standard.scene.objects[0]
    near, far = find_measured_range(pinhole, water)
    x, y, _ = plate.position_mm
    size = np.array([camera.width_px, camera.height_px])
    seen = image_of(pinhole, water, np.array([(x, y, near), (x, y, far)]))
    assert ((seen > 0) & (seen < size - 1)).all()
    along = 0 if camera.stripe_along == "width" else 1
    ends = np.array([(x, y - plate.height_mm / 2, far), (x, y + plate.height_mm / 2, far)])
    places = image_of(pinhole, water, ends)[:, along]
    assert places.min() < 0 and places.max() > size[along] - 1


def test_without_refraction_the_target_stands_in_the_medium_of_use(thesis):
    planned = plan_recordings(thesis, "air", reflectance=0.5)
    assert planned.step is None and planned.target.scene.window_mounted
    bare = altered(thesis, {"camera": {"window": {"mounted": False}}})
    assert not plan_recordings(bare, "air", reflectance=0.5).target.scene.window_mounted


def test_a_sensor_without_air_is_calibrated_in_air_all_the_same(thesis):
    media = {"harbour": thesis.media["water"], "air": thesis.media["water"]}
    planned = plan_recordings(thesis.model_copy(update={"media": media}), "harbour", reflectance=0.5)
    assert planned.target.sensor.medium(planned.target.scene.medium).kind == "air"
    assert planned.standard.sensor.media == media


def test_exposures_are_free_in_the_calibration_only(thesis):
    fixed = altered(thesis, {"exposure": {"laser_ms": 3.0}})
    planned = plan_recordings(fixed, "water", reflectance=0.5)
    assert planned.standard.sensor.exposure.laser_ms == 3.0
    assert planned.step.sensor.exposure.laser_ms == planned.target.sensor.exposure.laser_ms == "auto"


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # 265 mm / tan 80 deg = 46.7 mm: the sheet meets the camera's axis within the housing.
        ({"laser": {"triangulation_angle_deg": 80.0}}, "crosses the camera's axis 46.7 mm"),
        ({"volume": {"near_mm": 2000.0, "far_mm": 2500.0}}, "measuring volume reaches from 2000"),
        ({"camera": {"focus_distance_mm": 30.0}}, "nowhere in view and blurred by less"),
    ],
)
def test_impossible_designs_are_refused_before_anything_is_rendered(thesis, tmp_path, changes, message):
    with pytest.raises(DesignError, match=message):
        verify(altered(thesis, changes), "water", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_unknown_media_and_reflectances_are_refused(thesis, tmp_path):
    with pytest.raises(DescriptionError, match="knows the media air, water"):
        verify(thesis, "oil", tmp_path)
    with pytest.raises(DescriptionError, match="reflectance"):
        verify(thesis, "water", tmp_path, reflectance=1.5)


def test_the_softwares_complaint_becomes_an_error(tmp_path):
    missing = str(tmp_path / "no.h5")
    with pytest.raises(CalibrationError, match=f"^no capture at {missing}"):
        _run("calibrate", "--air", missing, "--out", str(tmp_path / "c.json"), fails_as=CalibrationError)


# --- comparison with the plane ----------------------------------------------------------------------------------------


def profile(rng: np.random.Generator, frame: int, count: int, *, scatter: float, error: float) -> np.ndarray:
    """Points (count, 3), frame, Y and Z, of a plane seen tilted and bent by some um."""
    y = np.linspace(-80.0, 80.0, count)
    z = error + 1e-4 * y + 2e-6 * (y**2 - np.mean(y**2)) + scatter * rng.standard_normal(count)
    return np.column_stack([np.full(count, float(frame)), y, z])


def test_scatter_error_and_length_of_known_profiles_are_found():
    rng, count = np.random.default_rng(5), 4000
    known = {2: (0.02, 0.03), 0: (0.05, -0.01)}
    points = np.vstack([profile(rng, frame, count, scatter=s, error=e) for frame, (s, e) in known.items()])
    points[100, 2] += 3.0  # one outlier
    found = _evaluate_points(points, np.array([-120.0, -60.0, 10.0]))
    assert found.z_mm.tolist() == [-10.0, 60.0, 120.0]
    assert found.points.tolist() == [count, 0, count]
    for place, frame in ((0, 2), (2, 0)):
        scatter, error = known[frame]
        # Standard errors: s / sqrt(2 n) = 0.011 s of the scatter, s / sqrt(n) = 0.016 s of the mean; four of them. The
        # limit of five standard deviations cuts 6e-7 of all points.
        assert found.scatter_mm[place] == pytest.approx(scatter, abs=0.045 * scatter)
        assert found.error_mm[place] == pytest.approx(error, abs=0.063 * scatter)
        assert found.line_mm[place] == pytest.approx(160.0)
    assert np.isnan([found.scatter_mm[1], found.error_mm[1]]).all() and found.line_mm[1] == 0


def test_a_cloud_with_too_few_points_everywhere_is_refused():
    points = profile(np.random.default_rng(1), 0, 19, scatter=0.02, error=0.0)
    with pytest.raises(EvaluationError, match="19 points at 2 depths"):
        _evaluate_points(points, np.array([-10.0, 10.0]))


# --- the whole way ----------------------------------------------------------------------------------------------------


def test_the_thesiss_sensor_measures_a_plane_in_water(thesis, tmp_path):
    """Loose physical bounds; the point is that twin and software, which share no mathematics, agree.

    With half of the pixels along each side, in the same view.
    """
    halved = altered(thesis, {"camera": {"width_px": 640, "height_px": 512, "pixel_size_um": 10.6}})
    found = verify(halved, "water", tmp_path, seed=3)
    assert len(found.z_mm) == STANDARD_DEPTHS and (np.diff(found.z_mm) > 0).all()
    assert (found.points > 0.95 * halved.camera.lines()).all()
    # Speckle of contrast 0.5 to 0.7 over a stripe of some 0.3 mm moves its centre by 0.02 to 0.03 mm along Z.
    assert ((found.scatter_mm > 0.01) & (found.scatter_mm < 0.06)).all()
    assert (np.abs(found.error_mm) < 0.1).all()
    # The line's length grows with the distance, and is between the designer's figures for 640 and 1280 columns.
    assert (np.diff(found.line_mm) > 0).all()
    assert ((found.line_mm > 100) & (found.line_mm < 220)).all()
    # Seven step images of all pixels give the window's distance with a standard deviation of 0.07 mm; seven of them.
    calibration = json.loads((tmp_path / "calibration.json").read_text(encoding="utf-8"))
    residuals = calibration["residuals"]
    assert residuals["window"]["distance_mm"] == pytest.approx(thesis.camera.window.distance_mm, abs=0.5)
    assert calibration["camera"]["fx_px"] == pytest.approx(halved.camera.focal_length_px(), rel=1e-3)
    assert residuals["camera"]["images"] == TARGET_POSES and calibration["provenance"]["warnings"] == []
    assert 0 < found.exposure_ms < thesis.exposure.longest_ms
    assert found.seconds > 0
