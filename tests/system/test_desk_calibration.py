"""Guided calibrations of the desk, through the real drivers: the twin as stage and camera, and a hand-held target."""

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests.uwlts.drawn_target import drawn_lamp, drawn_laser, target_pose
from tests.waiting import within
from twin.devices.gige_camera import GigeCamera
from twin.devices.grbl_controller import GrblController
from twin.devices.serve import ServedTwin, serve
from twin.scene.description import load_scene
from uwlts.calibration.sequential.sequential_calibration import calibrate_sequentially
from uwlts.desk.guided_plan import load_guided_plan
from uwlts.desk.instrument import Instrument
from uwlts.desk.shown_state import Board
from uwlts.errors import DescriptionError
from uwlts.model.library import load_sensor
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture, part_path
from uwlts.targets import CircleTarget

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

COUNT = 5
SENSOR = """
base = "thesis"
name = "small"
[camera]
width_px = 640
height_px = 512
pixel_size_um = 10.6
[laser]
waist_radius_mm = 0.6
[stage]
travel_mm = 400.0
resolution_mm = 0.01
settling_s = 0.0
"""
LATTICE = """
kind = "circles"
spacing_x_mm = 9.375
spacing_y_mm = 9.372
diameter_mm = 5.0
marker_diameter_mm = 2.0
columns = 25
rows = 29
origin = [12, 14]
marker_x = [1, 0]
marker_y = [0, 1]
"""
PLATE = CircleTarget(
    spacing_x_mm=12.0,
    spacing_y_mm=12.0,
    diameter_mm=7.0,
    marker_diameter_mm=3.0,
    columns=15,
    rows=13,
    origin=(7, 6),
    marker_x=(1, 0),
    marker_y=(0, 1),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("live")
    (place / "sensor.toml").write_text(SENSOR, encoding="utf-8")
    (place / "target.toml").write_text('base = "target"\ntitle = "Target"\nmedium = "air"\n', encoding="utf-8")
    return place


@pytest.fixture(scope="module")
def sensor(folder: Path) -> Sensor:
    return load_sensor(folder / "sensor.toml")


@pytest.fixture(scope="module")
def served(folder: Path, sensor: Sensor) -> Iterator[ServedTwin]:
    with serve(load_scene(folder / "target.toml"), sensor=sensor, spp=4, speed_up=100.0) as running:
        yield running


@pytest.fixture
def plan(folder: Path, served: ServedTwin) -> Path:
    path = folder / "plan.toml"
    path.write_text(
        f'title = "Tank"\nsensor = "sensor.toml"\ncamera = "{served.camera.address}"\nposes = "stage-normal"\n'
        f'[target]\n{LATTICE}\n[stage]\nport = "{served.controller.port}"\nfirst_mm = 90.0\nlast_mm = 310.0\n'
        f"count = {COUNT}\nfeed_mm_per_min = 900.0\nhome = true\n[wanted]\nfewest_images = 5\n",
        encoding="utf-8",
    )
    return path


class Guided:
    """A guided calibration of the desk's instrument, in this process and without a page."""

    def __init__(self, plan: Path, out: Path, *, resume: bool = False):
        self._board, self._done = Board("guided"), threading.Event()
        self.device = Instrument(self._board)
        self.device.ask(self.device.calibrate, load_guided_plan(plan), out, resume=resume, overwrite=False)
        self.device.ask(self._done.set)

    def __enter__(self) -> "Guided":
        return self

    def __exit__(self, *_: object) -> None:
        self.device.close()

    def is_done(self) -> bool:
        return self._done.is_set()

    def text(self) -> str:
        """Return the log, a line for each entry."""
        return "\n".join(line.text for line in self._board.lines())


def guided(plan: Path, out: Path, *, resume: bool = False) -> str:
    """Wait for the end of a guided calibration, and return its log."""
    with Guided(plan, out, resume=resume) as going:
        assert within(240, going.is_done), going.text()
        return going.text()


def dark(controller: GrblController) -> bool:
    """Return whether the laser goes off within a second."""
    return within(1.0, lambda: not controller.state().laser_on)


def frames_in(part: Path) -> int:
    if not part.exists():
        return 0
    with Capture(part) as capture:
        return len(capture)


def wait_for(part: Path, count: int) -> None:
    deadline = time.monotonic() + 60
    while frames_in(part) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def check_camera(path: Path, sensor: Sensor) -> None:
    """Compare with the description of the simulated sensor."""
    calibration = load_calibration(path)
    figures = calibration.residuals["camera"]
    # Circles are found to some 0.05 px in small images with noise.
    assert figures["rms_px"] < 0.12
    true_f, (true_cx, true_cy) = sensor.camera.focal_length_px(), sensor.camera.principal_point()
    # The lens's depth of field and the pixels leave some more than noise: 0.05 % of f, 0.5 px of the centre.
    assert calibration.camera.fx_px == pytest.approx(true_f, rel=5e-4)
    assert calibration.camera.cx_px == pytest.approx(true_cx, abs=0.6)
    assert calibration.camera.cy_px == pytest.approx(true_cy, abs=0.6)
    assert calibration.residuals["sheet"]["rms_mm"] < 0.1
    # The sheet's normal and the crossing with the camera's axis are those of the description.
    true = camera_from_object(sensor)
    assert np.degrees(np.arccos(np.array(calibration.sheet.normal) @ true[:3, 0])) < 0.1
    assert calibration.object_transform()[2, 3] == pytest.approx(true[2, 3], abs=0.5)


def test_the_stage_leads_to_the_twins_camera_and_sheet(served, plan, sensor, tmp_path):
    said = guided(plan, tmp_path / "c.json")
    assert dark(served.controller)
    accepted = re.findall(r"mm: (\d+) points, edges .* px, coverage (\d+) %, stripe on (\d+) lines, residual", said)
    assert len(accepted) == COUNT and all(int(points) > 100 for points, *_ in accepted)
    assert [int(share) for _, share, _ in accepted] == sorted(int(share) for _, share, _ in accepted)
    check_camera(tmp_path / "c.json", sensor)
    with Capture(tmp_path / "c-target.h5") as capture:
        assert capture.laser_on.tolist() == [False, True] * COUNT
        np.testing.assert_allclose(capture.stage_mm[::2], np.linspace(90, 310, COUNT), atol=0.011)
        assert not capture.header.sensor.camera.window.mounted and capture.header.medium_name == "air"
    # The captures give the same calibration again.
    with Capture(tmp_path / "c-target.h5") as capture:
        again = calibrate_sequentially([capture]).calibration
    assert load_calibration(tmp_path / "c.json").camera == again.camera


def test_a_guided_calibration_is_led_through_and_calculated(plan, served, chromium: "Browser"):
    place = plan.parent
    desk = subprocess.Popen([sys.executable, "-m", "uwlts", "desk", str(place)], stdout=subprocess.PIPE, text=True)
    try:
        assert desk.stdout
        address = desk.stdout.readline().split()[1]
        page = chromium.new_page(viewport={"width": 1400, "height": 850})
        page.set_default_timeout(120_000)
        page.goto(address)
        page.get_by_role("tab", name="Calibrate").click()
        page.get_by_label("plan of the calibration").click()
        page.get_by_role("option", name="plan.toml").click()
        page.get_by_role("button", name="begin", exact=True).click()
        page.get_by_text("positions left").wait_for()
        assert [page.get_by_role("button", name=each, exact=True).is_visible() for each in ("take", "skip", "done")]
        page.locator('img[src^="coverage.png"]').wait_for()
        page.locator(".log").get_by_text("wrote calibration.json").wait_for()
        assert within(1.0, lambda: not served.controller.state().laser_on)
        found = load_calibration(place / "calibration.json")
        with Capture(place / "calibration-target.h5") as target:
            assert (~target.laser_on).sum() == COUNT
        line = page.locator(".log").get_by_text(re.compile("camera: f ")).first.inner_text()
        assert f"f {found.camera.fx_px:.2f} x" in line
        page.close()
    finally:
        desk.send_signal(signal.SIGINT)
        with desk:
            assert desk.wait(60) == 0


def test_an_interrupted_one_is_dark_keeps_the_accepted_and_can_be_gone_on_from(served, plan, tmp_path):
    out, part = tmp_path / "c.json", part_path(tmp_path / "c-target.h5")
    with Guided(plan, out) as going:
        wait_for(part, 4)
        going.device.stop()
        assert within(60, going.is_done) and going.text().endswith("stopped")
        assert dark(served.controller) and not out.exists()
    kept = frames_in(part)
    assert 4 <= kept < 2 * COUNT
    said = guided(plan, out, resume=True)
    assert "wrote c.json" in said
    with Capture(tmp_path / "c-target.h5") as capture:
        assert len(capture) == 2 * COUNT and (np.diff(capture.time_s) > 0).all()
    # Recorded poses were not taken again.
    assert len(re.findall(r"mm: \d+ points", said)) == COUNT - kept // 2


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("home = true", "home = 1.5"), "home"),
        (("first_mm = 90.0\n", ""), "first_mm and last_mm"),
        (('poses = "stage-normal"', 'poses = "moving"'), "poses"),
        (("columns = 25", "columns = 1"), "columns"),
        (("[wanted]", '[step]\nmedium = "mud"\nheight_mm = 20.0\n[wanted]'), "mud"),
        (("[target]", 'medium = "water"\n[step]\nmedium = "water"\nheight_mm = 20.0\n[target]'), "set medium to air"),
    ],
)
def test_plans_that_make_no_sense_are_refused(plan, change, says):
    text = plan.read_text(encoding="utf-8")
    assert change[0] in text
    plan.write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(DescriptionError, match=says):
        load_guided_plan(plan)


def test_positions_beyond_the_travel_are_refused_before_anything_moves(served, plan, tmp_path):
    plan.write_text(plan.read_text(encoding="utf-8").replace("first_mm = 90.0", "first_mm = -90.0"), encoding="utf-8")
    before = served.controller.state().position_mm
    assert "the stage moves from 0 to 400 mm" in guided(plan, tmp_path / "c.json")
    assert served.controller.state().position_mm == before
    assert not list(tmp_path.iterdir())


class Tank:
    """A target held by hand before a camera, and a laser switched by a controller: the image at any moment."""

    def __init__(self, sensor: Sensor, controller: GrblController):
        self._sensor, self._controller = sensor, controller
        self._start = self._end = target_pose(middle_mm=(0.0, 0.0, 378.0))
        self._began_s, self._lasts_s = time.monotonic(), 0.001
        self._drawn: tuple[bytes, np.ndarray] | None = None
        self._seed = 0

    def bring(self, pose: np.ndarray, *, lasts_s: float = 0.5) -> None:
        """Begin to bring the target to another pose."""
        self._start, self._end, self._began_s, self._lasts_s = self._end, pose, time.monotonic(), lasts_s

    def frame(self, exposure_ms: float) -> np.ndarray:
        """Lamp or laser, with new noise; the exposure of 1 ms suits both."""
        share = min((time.monotonic() - self._began_s) / self._lasts_s, 1.0)
        pose = self._end if share >= 1 else self._start + share * (self._end - self._start)
        self._seed += 1
        if self._controller.state().laser_on:
            return drawn_laser(self._sensor, pose, gain=exposure_ms, seed=self._seed, half_mm=95.0)
        return drawn_lamp(self._sensor, PLATE, pose, gain=exposure_ms, seed=self._seed)


def hand_poses() -> Iterator[np.ndarray]:
    """Poses of an operator, repeatedly: all sides tilted away, near and far, all over the image."""
    rng = np.random.default_rng(4)
    while True:
        for angle in rng.permutation(8) * np.pi / 4:
            tilt = 22 * np.cos(angle), 22 * np.sin(angle)
            middle = (*rng.uniform(-25, 25, 2), rng.uniform(300, 440))
            yield target_pose(tilt_deg=tilt, middle_mm=middle)


def _hold(tank: Tank, going: subprocess.Popen[str], said: list[str]) -> None:
    """Hold the target still until it was taken, then move it, until the guide has enough."""
    poses, deadline, taken, asked = hand_poses(), time.monotonic() + 240, 0, False
    until = deadline
    while going.poll() is None:
        assert time.monotonic() < deadline, said
        count = sum("points, edges" in line for line in said)
        if count == 1 and not asked:
            # By hand, though it has not been moved.
            going.stdin.write("take\n")
            going.stdin.flush()
            asked = any("too similar" in line for line in said)
            time.sleep(0.3)
        elif count > taken or time.monotonic() > until:
            taken, until = count, time.monotonic() + 2.5
            tank.bring(next(poses))
        else:
            time.sleep(0.05)


def test_a_target_held_by_hand_is_led_to_a_calibration(served, folder, tmp_path):
    """Free poses, each taken by itself once the target is still; the same pose again is refused."""
    small = load_sensor(folder / "sensor.toml")
    served.camera.disconnect()
    controller = GrblController(position_mm=100.0)
    tank = Tank(small, controller)
    camera = GigeCamera(tank.frame, width_px=640, height_px=512)
    plan = folder / "free.toml"
    described = "\n".join(
        f"{k} = {list(v) if isinstance(v, tuple) else repr(v)}" for k, v in PLATE.model_dump(exclude_none=True).items()
    )
    try:
        with controller, camera:
            plan.write_text(
                f'title = "By hand"\nsensor = "sensor.toml"\ncamera = "{camera.address}"\nposes = "free"\n'
                f"lamp_ms = 1.0\nlaser_ms = 1.0\nstill_s = 0.3\n[target]\n{described}\n"
                f'[stage]\nport = "{controller.port}"\n[wanted]\nfocal_std_px = 0.5\ncoverage = 0.7\n'
                "fewest_images = 6\n",
                encoding="utf-8",
            )
            # The images are drawn in this process: the guide has one of its own, as the desk's program has.
            code = "import sys; from tests.system import guided_process as it; it.guide_calibration(*sys.argv[1:])"
            guide = [sys.executable, "-c", code, str(plan), str(tmp_path / "c.json")]
            said: list[str] = []
            with subprocess.Popen(guide, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as going:
                reader = threading.Thread(target=lambda: said.extend(going.stdout))
                reader.start()
                _hold(tank, going, said)
                reader.join()
                assert going.wait() == 0
            text = "".join(said)
            assert dark(controller)
    finally:
        served.camera.connect()
    assert "too similar to image 1" in text and "next: tilt the target" in text
    assert "wrote c.json" in text, text
    calibration = load_calibration(tmp_path / "c.json")
    assert calibration.residuals["camera"]["std"]["f"] < 0.5
    assert calibration.residuals["camera"]["rms_px"] < 0.15
    assert calibration.camera.fx_px == pytest.approx(small.camera.focal_length_px(), rel=2e-3)
    with Capture(tmp_path / "c-target.h5") as capture:
        assert 6 <= int((~capture.laser_on).sum()) <= 14
        assert capture.laser_on.any() and cv2.countNonZero(capture.image(0)) > 0
