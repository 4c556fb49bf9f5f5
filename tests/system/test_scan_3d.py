"""A scan by a 3D camera: the served twin gives Coord3D_C16 over GigE Vision, with an encoder's count in chunk data."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import uwlts
from tests.system.small_board import small_sensor, turned_board
from twin.devices.gige_camera import ExposedFrame, GigeCamera
from twin.devices.serve import ServedTwin, serve
from twin.recording.record_scene import record_scene
from twin.rendering_options import Flaws, Options
from twin.scene.description import Scene
from twin.sensor.detector import INVALID, PeakFinder
from uwlts.errors import DescriptionError, HardwareError
from uwlts.hardware import aravis
from uwlts.hardware.camera_interface import ReplayCamera
from uwlts.hardware.scanning import open_camera
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture
from uwlts.stripe import StripeStatus, extract_stripe

COUNT, STEP_MM, RESOLUTION_MM = 4, 2.0, 0.01
DESCRIPTIONS = {
    "sensor": small_sensor("travel_mm = 120.0", f"resolution_mm = {RESOLUTION_MM}", "settling_s = 0.0"),
    "board": turned_board("start_mm = -5.0", f"step_mm = {STEP_MM}", f"count = {COUNT}"),
}


@pytest.fixture(scope="module")
def served(board: Scene, sensor: Sensor) -> Iterator[ServedTwin]:
    with serve(board, sensor=sensor, spp=4, speed_up=50.0, effects=["camera-3d"]) as running:
        yield running


def plan(folder: Path, served: ServedTwin, *top: str) -> Path:
    path = folder / "plan.toml"
    stage = f"start_mm = {served.track.start_mm}\nstep_mm = {STEP_MM}\ncount = {COUNT}\nfeed_mm_per_min = 900.0\n"
    given = "\n".join(("check_steps = false", *(top or (f"laser_ms = {served.exposure_ms['laser']}",))))
    path.write_text(
        f'title = "Board"\nsensor = "sensor.toml"\nmedium = "air"\ncamera = "{served.camera.address}"\n{given}\n'
        f'[stage]\nport = "{served.controller.port}"\n{stage}',
        encoding="utf-8",
    )
    return path


def test_calibrated_coordinates_are_refused():
    class Calibrated(GigeCamera):
        def _features(self) -> bytes:
            return super()._features().replace(b'"UncalibratedC"', b'"CalibratedC"')

    sensor = load_sensor("thesis")
    finder = PeakFinder(sensor.camera, 255, 16)
    with (
        Calibrated(lambda exposure_ms: np.zeros((1024, 1280), np.uint8), scan3d=finder) as served,
        pytest.raises(HardwareError, match="gives CalibratedC, which is not in pixels"),
    ):
        open_camera(served.address).open()


ROWS, STAMP_NS = 8, 3_000_000
"""Number of profiles in a frame, and time between them."""


class Counting:
    """Exposures of a drawn 3D camera: each shows its number in the encoder's count, its time and its profile."""

    def __init__(self) -> None:
        self.number, self.began_s = -1, 1000.0

    def __call__(self) -> ExposedFrame:
        self.number += 1
        number = self.number
        return ExposedFrame(self.began_s + 1e-9 * STAMP_NS * number, 5 - 3 * number, lambda _: self.image(number))

    def image(self, number: int) -> np.ndarray:
        image = np.zeros((64, 96), np.uint8)
        # Two equally bright rows: the position is half-way between them.
        image[10 + number % 40 : 12 + number % 40] = 200
        return image


@pytest.fixture
def counting() -> Iterator[Counting]:
    exposures = Counting()
    small = load_sensor("thesis").camera.model_copy(update={"width_px": 96, "height_px": 64})
    served = GigeCamera(
        lambda exposure_ms: exposures.image(0),
        width_px=96,
        height_px=64,
        scan3d=PeakFinder(small, 255, 16),
        encoder=lambda: 0,
        expose=exposures,
    )
    with served:
        exposures.served = served
        yield exposures


def test_each_profile_of_a_frame_has_its_own_count_and_time(counting):
    with open_camera("gige:127.0.0.1") as camera:
        settings = camera.configure(exposure_ms=0.1, frame_rate_hz=200.0, profiles=ROWS)
        assert settings.rows == ROWS and settings.frame_rate_hz == pytest.approx(200.0)
        camera.start(faults="skip")
        grabbed = [camera.grab(5.0) for _ in range(3 * ROWS)]
        counting.served.inject("drop")
        while camera.counts.dropped == 0:
            grabbed.append(camera.grab(5.0))
        grabbed += [camera.grab(5.0) for _ in range(ROWS)]
        camera.stop()
    numbers = np.array([(5 - frame.encoder) // 3 for frame in grabbed])
    steps = np.diff(numbers)
    # All profiles of the lost frame are missing.
    assert set(steps) == {1, 1 + ROWS} and np.flatnonzero(steps > 1) % ROWS == ROWS - 1
    for number, frame in zip(numbers, grabbed, strict=True):
        assert (frame.seen.centre_px == 10.5 + number % 40).all()
        # Aravis's time stamps are whole ns.
        assert abs(frame.time_s - grabbed[0].time_s - 1e-9 * STAMP_NS * (number - numbers[0])) < 2e-9
    assert camera.counts.dropped == 1


def test_profiles_without_time_stamps_follow_the_line_rate_and_single_ones_their_trigger(counting, monkeypatch):
    with open_camera("gige:127.0.0.1") as camera:
        monkeypatch.setattr(aravis, "CHUNKS", ("EncoderValue",))
        camera.configure(exposure_ms=0.1, frame_rate_hz=100.0, profiles=ROWS)
        camera.start()
        times = np.array([camera.grab(5.0).time_s for _ in range(ROWS)])
        assert np.allclose(np.diff(times), 0.01, atol=1e-9)
        camera.stop()
        camera.configure(trigger="software")
        camera.start()
        camera.trigger()
        frame = camera.grab(5.0)
        assert frame.encoder == 0 and (frame.seen.centre_px == 10.5).all()
        camera.stop()
        with pytest.raises(HardwareError, match="profiles is 8: expected 1, or more for a free-running 3D camera"):
            camera.configure(trigger="software", profiles=ROWS)


def test_a_scan_holds_the_centre_lines_that_the_twin_simulates(served, folder, board, sensor, tmp_path):
    seen = uwlts.scan(plan(folder, served), tmp_path / "scan.h5", home=True)
    options = Options(spp=4, flaws=Flaws(camera_3d=16))
    record_scene(board, sensor, tmp_path / "simulated.h5", options=options)
    with Capture(tmp_path / "scan.h5") as scan, Capture(tmp_path / "simulated.h5") as simulated:
        assert len(scan) == COUNT and not scan.has_image.any() and not simulated.has_image.any()
        # The encoder counts the stage's steps.
        assert np.array_equal(scan.encoder, np.round(scan.stage_mm / RESOLUTION_MM))
        apart = np.concatenate(
            [scan.read_observation(k).centre_px - simulated.read_observation(k).centre_px for k in range(COUNT)]
        )
        lit = np.concatenate([scan.read_observation(k).status == StripeStatus.OK for k in range(COUNT)])
        assert seen.found == lit.sum() and lit.mean() > 0.3 and np.isfinite(apart).mean() > 0.9 * lit.mean()
        # Steps of 1/16 px, and the noise of both images: about 0.1 px each on a stripe some pixels wide.
        assert abs(np.nanmedian(apart)) <= 1 / 16 and np.nanquantile(np.abs(apart), 0.9) < 0.5
        calibration = uwlts.nominal(sensor, medium="air")
        cloud = uwlts.reconstruct(scan, calibration)
        # Except for two lines at each end of the stripe.
        assert 0.9 * np.count_nonzero(lit) < len(cloud) <= np.count_nonzero(lit) and np.isnan(cloud.intensity).all()
    with ReplayCamera(tmp_path / "scan.h5") as camera, Capture(tmp_path / "scan.h5") as scan:
        camera.configure()
        camera.start()
        for k in range(COUNT):
            frame = camera.grab(1.0)
            assert np.array_equal(frame.seen.centre_px, scan.read_observation(k).centre_px, equal_nan=True)
            assert frame.encoder == scan.encoder[k]
        with pytest.raises(HardwareError, match="where an image is needed"):
            _ = frame.image


@pytest.mark.parametrize(
    ("top", "words"),
    [
        (('laser_ms = "auto"',), "laser_ms is 'auto'"),
        (("laser_ms = 1.0", 'lights = ["lamp", "laser"]'), "lights holds 'lamp'"),
        (("laser_ms = 1.0", "background = true", "bracket = [1, 4]"), "background is true and bracket"),
    ],
)
def test_what_needs_images_says_so(served, folder, tmp_path, top, words):
    with pytest.raises(DescriptionError, match=f"gives no images .*{re.escape(words)}"):
        uwlts.scan(plan(folder, served, *top), tmp_path / "scan.h5", home=True)


def test_the_camera_gives_images_where_a_program_asks_for_them(served):
    """Its pixel format stays as the last program set it."""
    with open_camera(served.camera.address) as camera:
        assert camera.info.coordinates is not None and camera.info.coordinates.invalid == INVALID
        camera._call("set_pixel_format_from_string", b"Mono8")
    with open_camera(served.camera.address) as camera:
        assert camera.info.coordinates is None
        camera.configure(exposure_ms=1.0, trigger="software")
        camera.start()
        camera.trigger()
        assert camera.grab(20.0).image.shape == (camera.info.height_px, camera.info.width_px)
        camera._call("stop_acquisition")
        camera._call("set_pixel_format_from_string", b"Coord3D_C16")


def test_the_peak_finder_agrees_with_the_stripe_and_marks_what_it_does_not_see():
    sensor = load_sensor("thesis")
    camera = sensor.camera.model_copy(update={"width_px": 200, "height_px": 160})
    rows, centre = np.arange(160)[:, None], 40 + np.linspace(0, 60, 200)
    image = 20 + 180 * np.exp(-0.5 * ((rows - centre) / 2.0) ** 2)
    image[:, 50:60] = 20
    image[80, 55] = 255
    noisy = np.clip(image + np.random.default_rng(3).normal(0, 1, image.shape), 0, 255).round().astype(np.uint8)
    darker = np.maximum(noisy.astype(int) - 15, 0).astype(np.uint8)
    numbers = PeakFinder(camera, 255, 16).numbers(darker)
    assert numbers.dtype == np.uint16 and (numbers[50:60] == INVALID).all()
    seen = numbers != INVALID
    assert seen.sum() == 190
    found = extract_stripe(darker, stripe_along="width")
    both = seen & (found.status == StripeStatus.OK)
    # Half a step of 1/16 px, and noise of 1 grey level on both methods: 0.02 px; five sigma.
    assert both.sum() > 170 and np.abs(numbers[both] / 16 - found.centre_px[both]).max() < 1 / 32 + 0.1
    turned = camera.model_copy(update={"stripe_along": "height", "width_px": 160, "height_px": 200})
    assert np.array_equal(PeakFinder(turned, 255, 16).numbers(darker.T), numbers)
