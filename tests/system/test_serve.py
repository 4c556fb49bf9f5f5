"""The served twin through the real drivers: effects of stage, laser and exposure on the image, and faults."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.system.small_board import small_sensor, turned_board
from twin.devices.serve import NAMES, Fault, ServedTwin, Track, parse_fault, serve
from twin.recording.record_scene import record_scene
from twin.rendering_options import Options
from twin.scene.description import Scene, load_scene
from uwlts.errors import DescriptionError, DesignError, HardwareError, ImageError
from uwlts.hardware.camera_interface import CameraDevice
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scanning import open_camera
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture
from uwlts.stripe import extract_stripe

ROOT = Path(__file__).resolve().parents[2]
WAIT_S = 20.0
FEED = 900.0
FAST = 50.0
MOTION = ("start_mm = -4.0", "step_mm = 4.0", "count = 3", "position_errors_mm = [0.0, 0.5, 0.0]")
DESCRIPTIONS = {"sensor": small_sensor(), "board": turned_board(*MOTION)}


@pytest.fixture(scope="module", autouse=True)
def patient_guard() -> Iterator[None]:
    """Frames come when they are rendered, and the laser is left on between tests: its guard is not at issue here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uwlts.hardware.grbl_line.GRACE_S", 600.0)
        yield


@pytest.fixture(scope="module")
def served(board: Scene, sensor: Sensor) -> Iterator[ServedTwin]:
    with serve(board, sensor=sensor, spp=4, speed_up=FAST) as running:
        yield running


@pytest.fixture(scope="module")
def stage(served: ServedTwin) -> Iterator[GrblStage]:
    with GrblStage(served.controller.port) as opened:
        opened.home()
        yield opened


@pytest.fixture
def camera(served: ServedTwin) -> Iterator[CameraDevice]:
    with open_camera(served.camera.address) as opened:
        yield opened


def start(camera: CameraDevice, exposure_ms: float) -> None:
    camera.stop()
    camera.configure(exposure_ms=exposure_ms, trigger="software")
    camera.start()


def grab(camera: CameraDevice) -> np.ndarray:
    camera.trigger()
    return camera.grab(WAIT_S).image


def grab_lit(camera: CameraDevice, stage: GrblStage, *, power: float = 1.0) -> np.ndarray:
    """An image with laser; its rendering may take longer than the light."""
    stage.laser(True, power=power)
    try:
        return grab(camera)
    finally:
        stage.laser(False)


def centres(image: np.ndarray) -> np.ndarray:
    """Stripe centres (96,) in px, nan without a stripe."""
    return extract_stripe(image, stripe_along="width").centre_px


# Content of a frame


@pytest.mark.slow
def test_a_scan_shows_what_simulate_shows(served, stage, camera, board, sensor, tmp_path):
    """Same positions, including errors of the stage: same stripe, apart from the noise."""
    record_scene(board, sensor, tmp_path / "board.h5", options=Options(spp=4))
    with Capture(tmp_path / "board.h5") as capture:
        expected = [image for _, image in capture.frames()]
        positions, exposure_ms = capture.stage_mm[:], float(capture.exposure_ms[0])
    assert served.exposure_ms["laser"] == pytest.approx(exposure_ms)
    start(camera, exposure_ms)
    seen = []
    for position_mm in positions:
        stage.move_to(position_mm + served.track.offset_mm, feed_mm_per_min=FEED)
        seen.append(grab_lit(camera, stage))
    for one, other in zip(seen, expected, strict=True):
        apart = np.abs(centres(one) - centres(other))
        assert np.isfinite(apart).mean() > 0.9
        assert np.nanmedian(apart) < 0.1
        # Both have the same speckle and fixed pattern. They differ by the readout's noise, 22 electrons of 0.0253 DN,
        # and by rounding, 1 / sqrt(12) DN, of both images: 0.89 DN; the stripe's few pixels add some shot noise.
        assert 0.8 < np.std(one.astype(float) - other) < 1.0
    # The stripe moves from place to place by far more than that.
    assert all(abs(np.nanmedian(centres(b) - centres(a))) > 1 for a, b in pairwise(seen))


def test_laser_and_exposure_make_the_light(served, stage, camera):
    exposure_ms = served.exposure_ms["laser"]
    stage.move_to(served.track.start_mm, feed_mm_per_min=FEED)
    start(camera, exposure_ms)
    full = grab_lit(camera, stage).astype(float)
    stripe = full > 0.4 * full.max()
    assert stripe.sum() > 96
    dark_dn = np.median(full[:50])
    half = grab_lit(camera, stage, power=0.5).astype(float)
    start(camera, exposure_ms / 2)
    shorter = grab_lit(camera, stage).astype(float)
    off = grab(camera).astype(float)
    # The mean over more than 96 pixels of about 100 DN, each with shot and read noise below 4 DN, is right to 0.4 DN.
    light = (full - dark_dn)[stripe].mean()
    assert (half - dark_dn)[stripe].mean() == pytest.approx(light / 2, abs=1)
    assert (shorter - dark_dn)[stripe].mean() == pytest.approx(light / 2, abs=1)
    assert off[stripe].mean() < dark_dn + 0.05 * light
    start(camera, 100 * exposure_ms)
    assert (grab_lit(camera, stage)[stripe] == 255).all()


def test_daylight_stays_when_the_laser_is_off(served, stage, camera):
    """In proportion to the exposure; dark current is a hundredth of it."""
    stage.move_to(served.track.start_mm, feed_mm_per_min=FEED)
    stage.laser(False)
    levels = []
    for exposure_ms in (1.0, 21.0, 41.0):
        start(camera, exposure_ms)
        levels.append(float(np.mean(grab(camera))))
    # Means over 49152 pixels with noise below 4 DN are right to 0.02 DN.
    assert 20 < levels[1] - levels[0] < 120
    assert levels[2] - levels[1] == pytest.approx(levels[1] - levels[0], abs=0.2)


def test_at_rest_only_the_noise_is_new(served, stage, camera):
    stage.move_to(served.track.start_mm + 1, feed_mm_per_min=FEED)
    start(camera, served.exposure_ms["laser"])
    before = served.bench.frames, served.bench.renderings
    images = [grab_lit(camera, stage) for _ in range(5)]
    assert (served.bench.frames - before[0], served.bench.renderings - before[1]) == (5, 1)
    assert all(not np.array_equal(a, b) for a, b in pairwise(images))


def test_a_laser_that_breaks_leaves_the_dark(served, stage, camera):
    stage.move_to(served.track.start_mm, feed_mm_per_min=FEED)
    start(camera, served.exposure_ms["laser"])
    bright = grab_lit(camera, stage).max()
    assert bright > 100
    served.controller.inject("break-laser")
    try:
        assert grab_lit(camera, stage).max() < 0.2 * bright
    finally:
        served.controller.inject("break-laser", 0)


# Position of the scene


def test_the_motion_lies_in_the_middle_of_the_travel_or_where_it_is_wanted(served, board, sensor):
    assert served.track.start_mm == pytest.approx((750 - 8) / 2)
    assert served.controller.state().position_mm == pytest.approx(served.track.start_mm, abs=750)
    assert served.track.offset_mm == pytest.approx(served.track.start_mm + 4)
    track = Track.place(sensor.stage, board.motion, start_mm=20.0)
    shots = [track.shot(position_mm, "laser") for position_mm in (20.0, 24.0, 26.0, 40.0)]
    assert [shot.stage_mm for shot in shots] == [-4, 0, 2, 16]
    assert [shot.travelled_mm for shot in shots] == [-4, 0.5, 2.25, 16]
    back = board.motion.model_copy(update={"start_mm": 4.0, "step_mm": -4.0, "position_errors_mm": (0.0, 0.5, 1.0)})
    assert Track.place(sensor.stage, back).start_mm == pytest.approx((750 + 8) / 2)
    assert Track.place(sensor.stage, back, start_mm=8.0).shot(0.0, "laser").travelled_mm == -4 + 1
    for start_mm in (-1.0, 743.0):
        with pytest.raises(DescriptionError, match="would run from .* travel is 0 to 750 mm"):
            Track.place(sensor.stage, board.motion, start_mm=start_mm)
    with pytest.raises(DescriptionError, match="travel is 0 to 750 mm"):
        Track.place(sensor.stage, board.motion.model_copy(update={"count": 300, "position_errors_mm": ()}))


def test_a_detector_of_more_bits_is_refused(board, sensor):
    finer = sensor.model_copy(update={"detector": sensor.detector.model_copy(update={"bits": 10})})
    with pytest.raises(DesignError, match=r"has 8 bits, .* detector 10"), serve(board, sensor=finer):
        pass


def test_lamp_and_laser_at_once_are_refused(board, sensor):
    with (
        pytest.raises(
            DescriptionError, match="lamp-and-laser cannot be served, because the controller switches the laser"
        ),
        serve(board, sensor=sensor, effects=["lamp-and-laser"]),
    ):
        pass


# Faults


def test_faults_are_read():
    assert parse_fault("drop") == Fault("drop", 1, 1)
    assert parse_fault("delay:0.5@7") == Fault("delay", 0.5, 7)
    assert parse_fault("lose-steps:-40@2") == Fault("lose-steps", -40, 2)
    assert parse_fault("stall@3") == Fault("stall", None, 3)
    assert len(NAMES) == 16
    for wrong, message in [
        ("fire", "'fire' is not a fault: .* break-laser"),
        ("drop@0", "not a fault"),
        ("drop@x", "not a fault"),
        ("stall:2", "stall takes no argument"),
        ("drop:1.5", "'1.5', not a whole number"),
        ("delay:soon", "'soon', not a number of seconds"),
        ("delay:inf", "'inf'; it must be positive"),
        ("cut:-1", "'-1'; it must be positive"),
    ]:
        with pytest.raises(DescriptionError, match=message):
            parse_fault(wrong)


@pytest.fixture
def lamp_lit(folder: Path) -> Scene:
    """The board under the lamp while the laser is off."""
    board = load_scene(folder / "board.toml")
    return board.model_copy(update={"motion": board.motion.model_copy(update={"lights": ("lamp", "laser")})})


@pytest.mark.slow
def test_the_lamp_is_on_while_the_laser_is_off_and_frames_are_dropped_and_late(lamp_lit, sensor, served):
    """One camera only can be served: the module's one is away meanwhile."""
    served.camera.disconnect()
    said: list[str] = []
    faults = ("drop@2", "delay:1@4", "alarm:1@4", "stage-disconnect@5")
    try:
        with (
            serve(lamp_lit, sensor=sensor, spp=1, fault=faults, speed_up=FAST, report=said.append) as twin,
            open_camera(twin.camera.address) as camera,
        ):
            assert list(twin.exposure_ms) == ["lamp", "laser"]
            with pytest.raises(HardwareError, match="gone|lost"), GrblStage(twin.controller.port) as stage:
                stage.home()
                stage.move_to(twin.track.start_mm, feed_mm_per_min=FEED)
                start(camera, twin.exposure_ms["lamp"])
                # The plate fills the image: all of it is lit, not a stripe alone.
                assert np.median(grab(camera)) > 50
                camera.trigger()
                with pytest.raises(HardwareError, match="did not answer a trigger"):
                    camera.grab(1.0)
                assert np.median(grab_lit(camera, stage)) < 20
                began = time.monotonic()
                grab(camera)
                assert time.monotonic() - began > 1
                with pytest.raises(HardwareError, match="ALARM:1"):
                    stage.move_to(100.0, feed_mm_per_min=FEED)
                assert not twin.controller.state().laser_on
                grab(camera)
                stage.home()
            assert twin.camera.failure is None
        assert said == [
            "fault: drop:1 at frame 2",
            "fault: delay:1 at frame 4",
            "fault: alarm:1 at frame 4",
            "fault: stage-disconnect at frame 5",
        ]
    finally:
        served.camera.connect()


def test_a_camera_that_is_gone_says_so_and_what_keeps_it_from_frames_ends_the_service(board, sensor, served):
    served.camera.disconnect()
    try:
        faults = ["camera-disconnect@2"]
        with serve(board, sensor=sensor, spp=1, fault=faults) as twin, open_camera(twin.camera.address) as camera:
            start(camera, 1.0)
            grab(camera)
            camera.trigger()
            with pytest.raises(HardwareError, match="If it does not answer, check power and cable"):
                camera.grab(0.5)
            assert twin.camera.failure is None
            twin.camera.failure = ImageError("no frame can be made")
            with pytest.raises(ImageError, match="no frame can be made"):
                twin.wait_for_end()
    finally:
        served.camera.connect()


# The command


def test_the_command_serves_until_it_is_interrupted(folder: Path, served):
    served.camera.disconnect()
    arguments = ["serve", folder / "board.toml", "--sensor", folder / "sensor.toml", "--ideal", "--spp", 1]
    program = [sys.executable, "-m", "twin", *map(str, arguments), "--stage-start", "50", "--speed-up", "50"]
    command = subprocess.Popen(
        program, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        lines = []
        while "Ctrl-C" not in (line := command.stdout.readline()):
            assert line, command.stderr.read()
            lines.append(line)
        said = "".join(lines)
        port, address = re.search(r"stage: +(/dev/\S+)\ncamera: +(\S+)\n", said).groups()
        assert "3 positions, 50 to 58 mm of the stage in steps of 4 mm" in said
        assert "the stage's less 54 mm" in said
        exposure_ms = float(re.search(r"exposure: laser (\S+) ms", said)[1])
        with GrblStage(port) as stage, open_camera(address) as camera:
            stage.home()
            stage.move_to(54.0, feed_mm_per_min=FEED)
            start(camera, exposure_ms)
            assert np.isfinite(centres(grab_lit(camera, stage))).mean() > 0.9
        command.send_signal(signal.SIGINT)
        output, errors = command.communicate(timeout=20)
    finally:
        command.kill()
        command.communicate()
        served.camera.connect()
    assert (command.returncode, errors) == (0, "")
    assert output == "ended after 1 frames\n"
    assert not Path(port).exists()
