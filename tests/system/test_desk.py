"""The operator's page in a real browser, with the twin as the hardware: all steps, faults, viewers.

Screenshots of the first run are stored in the folder named by UWLTS_SCREENSHOTS.
"""

import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import pytest

import uwlts
from tests import preloaded
from tests.system import in_process
from tests.system.small_board import small_sensor, turned_board
from tests.system.test_laser_off_attacked import light
from tests.waiting import suspend, within
from twin.devices.serve import ServedTwin, serve
from twin.scene.description import Scene
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture, CaptureHeader, Frame, part_path
from uwlts.storage.capture_writer import CaptureWriter

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route, WebSocketRoute

COUNT = 8
DESCRIPTIONS = {
    "sensor": small_sensor("travel_mm = 120.0", "resolution_mm = 0.01", "settling_s = 0.0"),
    "board": turned_board("start_mm = -5.0", "step_mm = 2.0", "count = 6"),
}
SLOW_MS = 60_000
TABS = ("Connect", "Stage", "Calibrate", "Scan", "Files", "Inspect", "Measure")


@pytest.fixture(scope="module")
def served(board: Scene, sensor: Sensor) -> Iterator[ServedTwin]:
    with serve(board, sensor=sensor, spp=4, speed_up=50.0) as running:
        yield running


class Desk:
    """A desk in a process of its own, with a folder that holds a plan and a nominal calibration."""

    def __init__(self, folder: Path, served: ServedTwin, sensor_file: Path):
        self.folder = folder
        (folder / "sensor.toml").write_text(sensor_file.read_text())
        (folder / "plan.toml").write_text(
            f'title = "Board"\nsensor = "sensor.toml"\nmedium = "air"\ncamera = "{served.camera.address}"\n'
            f'[stage]\nport = "{served.controller.port}"\nstart_mm = {served.track.start_mm}\nstep_mm = 1.5\n'
            f'count = {COUNT}\nfeed_mm_per_min = 900.0\n[artefact]\nkind = "plane"\n'
        )
        uwlts.nominal(folder / "sensor.toml", medium="air").save(folder / "nominal.json")
        self.process = preloaded.uwlts("desk", str(folder), "--plan", str(folder / "plan.toml"), "--port", "18300")
        line = self.process.stdout.readline()
        found = re.search(r"open (\S+) to work, (\S+) to look", line)
        assert found, line or self.process.communicate()[1]
        self.operator_address, self.address = found.groups()

    def end(self) -> tuple[int, str]:
        """Ctrl-C; the exit status and what it wrote to standard error."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        return self.process.wait(60), self.process.communicate()[1]


@pytest.fixture
def desk(tmp_path: Path, folder: Path, served: ServedTwin) -> Iterator[Desk]:
    running = Desk(tmp_path, served, folder / "sensor.toml")
    yield running
    status, errors = running.end()
    assert status == 0 and "Traceback" not in errors, errors


@pytest.fixture
def page(desk: Desk, chromium: "Browser") -> "Iterator[Page]":
    """The operator's page, without requests to other machines or script errors."""
    with watched(chromium.new_page(viewport={"width": 1400, "height": 850})) as opened:
        opened.set_default_timeout(SLOW_MS)
        opened.goto(desk.operator_address)
        yield opened
        print(opened.locator("header").inner_text(), opened.locator(".log").inner_text(), sep="\n")


class watched:
    """A page whose errors and requests to other machines fail the test."""

    def __init__(self, page: "Page"):
        self.page = page
        self.wrong: list[str] = []
        page.on("pageerror", lambda error: self.wrong.append(str(error)))
        page.on("request", lambda request: self._asked(request.url))

    def _asked(self, url: str) -> None:
        if urlsplit(url).hostname not in ("127.0.0.1", None):
            self.wrong.append(url)

    def __enter__(self) -> "Page":
        return self.page

    def __exit__(self, *_: Any) -> None:
        self.page.close()
        assert not self.wrong


def press(page: "Page", name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def tab(page: "Page", name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def says(page: "Page", text: str) -> None:
    """Wait until the log matches a regular expression."""
    page.locator(".log").get_by_text(re.compile(text)).first.wait_for()


def shows(page: "Page", text: str) -> None:
    """Wait until the header matches."""
    page.locator("header").get_by_text(text).first.wait_for()


def connected(page: "Page") -> None:
    press(page, "connect")
    says(page, "connected: Grbl")
    shows(page, "has to be homed")
    tab(page, "Stage")
    press(page, "home")
    says(page, "homing done")


def scanning(page: "Page") -> None:
    """A scan of 60 images is being recorded."""
    connected(page)
    start_scan(page)


def start_scan(page: "Page") -> None:
    """Start a scan of 60 images."""
    tab(page, "Scan")
    page.get_by_label("positions").fill("60")
    page.get_by_label("step, mm").fill("0.2")
    press(page, "start")
    shows(page, "of 60")


def dark(served: ServedTwin) -> bool:
    return within(1.0, lambda: not served.controller.state().laser_on)


def write_scan(path: Path, sensor_file: Path) -> None:
    """A capture with three images of noise."""
    sensor = uwlts.load_sensor(sensor_file)
    header = CaptureHeader(
        name="old",
        sensor=sensor,
        medium_name="air",
        medium=sensor.medium("air"),
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=sensor.detector.full_scale_dn(),
    )
    rng = np.random.default_rng(0)
    with CaptureWriter(path, header, dtype=np.dtype(np.uint8)) as writer:
        for k in range(3):
            image = rng.integers(3, 9, (sensor.camera.height_px, sensor.camera.width_px), np.uint8)
            writer.append(Frame(image, float(k), False, 1.0, float(k)))


def kept(page: "Page", name: str) -> None:
    if folder := os.environ.get("UWLTS_SCREENSHOTS"):
        page.screenshot(path=f"{folder}/desk-{name}.png")


def test_the_whole_way_of_a_first_time_operator(desk, page, served):
    kept(page, "begin")
    connected(page)
    page.locator('img[src^="picture.jpg"]').wait_for()
    tab(page, "Connect")
    press(page, "laser")
    shows(page, "laser ON for images")
    page.get_by_text("of 96 profile lines").wait_for()
    press(page, "find exposure")
    says(page, "laser: exposed by")
    kept(page, "laser")
    tab(page, "Scan")
    page.get_by_label("calibration for the cloud").click()
    page.get_by_role("option", name="nominal.json").click()
    # Measured in the profile of the live images, which follows the laser.
    tab(page, "Measure")
    page.wait_for_timeout(2000)
    press(page, "live profile")
    plot = page.locator(".plot")
    plot.wait_for()
    around = plot.bounding_box()
    assert around and {"Y / mm", "Z / mm"} <= set(page.locator(".plot text").all_text_contents())
    for share in (0.4, 0.8):
        page.mouse.click(around["x"] + share * around["width"], around["y"] + around["height"] / 2)
        page.wait_for_timeout(300)
    page.get_by_text(re.compile(r"profile at X [\d.]+ mm: length: distance")).wait_for()
    press(page, "keep")
    page.locator(".measured").get_by_text("the calibration states no uncertainty").wait_for()
    kept(page, "profile")
    tab(page, "Stage")
    page.get_by_role("button", name="move by +10 mm").click()
    shows(page, "stage at 12.0")
    tab(page, "Scan")
    press(page, "start")
    shows(page, f"of {COUNT}")
    kept(page, "scan")
    says(page, "wrote scan.h5")
    assert dark(served)
    with Capture(desk.folder / "scan.h5") as scan:
        assert len(scan) == COUNT and scan.laser_on.all()
    page.get_by_text(re.compile(r"scan\.h5: [1-9]\d\d points")).wait_for()
    tab(page, "Files")
    press(page, "reconstruct")
    says(page, "wrote scan.cloud.h5")
    cloud = uwlts.read(desk.folder / "scan.cloud.h5")
    page.locator(f'.cloud-view[data-points="{len(cloud)}"]').wait_for()
    tab(page, "Measure")
    box = page.locator(".cloud-view canvas").first.bounding_box()
    assert box
    # Across the profiles: some of the clicks meet points.
    for v in np.linspace(0.2, 0.8, 61):
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] * float(v))
    press(page, "length")
    says(page, "length: distance")
    press(page, "plane")
    says(page, "plane: standard deviation")
    kept(page, "measure")
    line = page.locator(".log").get_by_text("plane: standard deviation").first.inner_text()
    found = float(re.findall(r"deviation ([\d.]+) mm", line)[0])
    # The board's points off their plane, by another way: all of them instead of those about the click.
    centred = cloud.points_mm - cloud.points_mm.mean(axis=0)
    assert found == pytest.approx(np.linalg.svd(centred)[1][2] / np.sqrt(len(cloud)), rel=0.5)
    tab(page, "Connect")
    press(page, "disconnect")
    says(page, "disconnected")


def test_state_picture_and_log_agree(desk, page, served):
    """Before and after homing, and after Laser off."""
    caption = page.locator(".image")
    press(page, "connect")
    says(page, "connected: Grbl")
    caption.get_by_text("live, lamp").wait_for()
    lit = len(served.controller.lights)
    press(page, "laser")
    says(page, "warning: the laser stays off: the stage has to be homed")
    page.wait_for_timeout(1000)
    assert len(served.controller.lights) == lit
    assert "laser off" in page.locator("header").inner_text() and "live, lamp" in caption.inner_text()
    tab(page, "Stage")
    press(page, "home")
    says(page, "homing done")
    tab(page, "Connect")
    press(page, "laser")
    shows(page, "laser ON for images")
    caption.get_by_text("live, laser").wait_for()
    says(page, "live images with laser")
    assert len(served.controller.lights) > lit
    press(page, "Laser off")
    caption.get_by_text("not live, laser").wait_for()
    shows(page, "laser off")
    says(page, "switched off by hand")
    assert dark(served)


@pytest.mark.slow
def test_a_scan_is_paused_stopped_and_continued(desk, page, served):
    scanning(page)
    press(page, "pause")
    says(page, "paused, the laser is off")
    shows(page, "laser off")
    assert dark(served)
    done = re.findall(r"(\d+) of 60", page.locator("header").inner_text())
    page.wait_for_timeout(1500)
    assert done and re.findall(r"(\d+) of 60", page.locator("header").inner_text()) == done
    press(page, "resume")
    page.wait_for_timeout(500)
    press(page, "stop")
    says(page, "stopped")
    assert dark(served) and part_path(desk.folder / "scan.h5").is_file()
    press(page, "start")
    says(page, "scan.h5 was interrupted")
    press(page, "continue interrupted")
    says(page, "wrote scan.h5")
    with Capture(desk.folder / "scan.h5") as scan:
        assert len(scan) == 60
        np.testing.assert_allclose(np.diff(scan.stage_mm), 0.2, atol=0.011)


@pytest.mark.parametrize("how", ["button", pytest.param("Escape", marks=pytest.mark.slow)])
def test_laser_off_works_in_a_scan(desk, page, served, how):
    scanning(page)
    if how == "button":
        press(page, "Laser off")
    else:
        page.keyboard.press("Escape")
    says(page, "laser switched off by hand")
    assert dark(served)
    shows(page, "has to be homed")
    shows(page, "laser off")
    with Capture(part_path(desk.folder / "scan.h5")) as left:
        assert 0 < len(left) < 60
    tab(page, "Stage")
    press(page, "unlock")
    says(page, "unlocking done")
    tab(page, "Scan")
    press(page, "continue interrupted")
    shows(page, "of 60")


@pytest.mark.slow
def test_laser_off_works_while_the_stage_moves_and_in_the_live_image(desk, page, served):
    connected(page)
    tab(page, "Connect")
    press(page, "laser")
    assert within(20.0, lambda: served.controller.state().laser_on)
    press(page, "Laser off")
    assert dark(served)
    says(page, "laser switched off by hand")
    page.wait_for_timeout(1000)
    assert not served.controller.state().laser_on
    shows(page, "has to be homed")
    tab(page, "Stage")
    press(page, "unlock")
    says(page, "unlocking done")
    # The light is not switched on again automatically.
    page.wait_for_timeout(1000)
    assert not served.controller.state().laser_on
    tab(page, "Connect")
    press(page, "laser")
    assert within(20.0, lambda: served.controller.state().laser_on)
    # Live images flash several times a second; they end 5 s after the page.
    page.goto("about:blank")
    time.sleep(8.0)
    assert not within(1.5, lambda: served.controller.state().laser_on)
    page.goto(desk.operator_address)
    says(page, "no operator's page is open")


SIZES = {"desktop": (1280, 800), "tablet": (800, 1280), "phone": (390, 844)}
MOBILE = (
    "Mozilla/5.0 (Linux; Android 14; Pixel 8) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/130.0 Mobile Safari/537.36"
)
"""User agent of a phone, for which Quasar opens choices as dialogs."""


@pytest.fixture(params=["desktop", "phone", pytest.param("tablet", marks=pytest.mark.slow)])
def sized(request: pytest.FixtureRequest, desk: Desk, chromium: "Browser") -> "Iterator[Page]":
    """The operator's page on a screen of this size, where it is a mobile one with a finger in place of a mouse."""
    width, height = SIZES[request.param]
    mobile = {} if request.param == "desktop" else {"has_touch": True, "user_agent": MOBILE}
    with watched(chromium.new_page(viewport={"width": width, "height": height}, **mobile)) as opened:
        opened.set_default_timeout(SLOW_MS)
        opened.goto(desk.operator_address)
        yield opened
        print(opened.locator("header").inner_text(), opened.locator(".log").inner_text(), sep="\n")


class LaserOff:
    """Presses the button as an operator does, at its place on the screen, and looks at the light."""

    def __init__(self, page: "Page", served: ServedTwin):
        self.page, self.controller, self.states = page, served.controller, []
        self._tap = page.evaluate("navigator.maxTouchPoints > 0")

    def works(self, state: str) -> None:
        """Press with a steady light on, which another program has switched on."""
        light(self.controller)
        self.press(state)

    def ends_flashes(self, state: str) -> None:
        """Press while the program itself takes laser images: no light follows."""
        before = len(self.controller.lights)
        assert within(60.0, lambda: len(self.controller.lights) > before), state
        self.press(state)

        def quiet() -> bool:
            lit = len(self.controller.lights)
            return not within(1.0, lambda: len(self.controller.lights) > lit)

        assert within(5.0, quiet), state
        assert not within(2.0, lambda: self.controller.state().laser_on), state

    def press(self, state: str) -> None:
        """Press the button at its place on the screen; the light goes off."""
        box = self.page.locator("#laser-off").bounding_box()
        assert box and box["width"] >= 44 and box["height"] >= 44
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        shown = self.page.evaluate("([x, y]) => document.elementFromPoint(x, y).id", [x, y])
        (self.page.touchscreen.tap if self._tap else self.page.mouse.click)(x, y)
        # Judged by the light only: it is off within 1 s on an idle machine.
        assert within(5.0, lambda: not self.controller.state().laser_on), state
        assert shown == "laser-off", state
        kept(self.page, f"off-{self.page.viewport_size['width']}-{state}")
        self.states.append(state)

    def works_zoomed(self) -> None:
        """Zoom in by pinching, and press where the button is on the screen."""
        light(self.controller)
        session = self.page.context.new_cdp_session(self.page)
        session.send("Emulation.setPageScaleFactor", {"pageScaleFactor": 3})
        self.page.wait_for_function("visualViewport.scale === 3")
        # In the page's pixels from the corner of the visible part, as the protocol sends touches.
        left, top, right, bottom, width, height = self.page.evaluate(
            """() => {
              const { left, top, right, bottom } = document.getElementById("laser-off").getBoundingClientRect();
              const { offsetLeft: x, offsetTop: y, width, height } = visualViewport;
              return [left - x, top - y, right - x, bottom - y, width, height];
            }"""
        )
        assert left >= 0 and right <= width and top >= 0 and bottom <= height
        assert 3 * (right - left) >= 44 and 3 * (bottom - top) >= 44
        place = {"x": (left + right) / 2, "y": (top + bottom) / 2}
        session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [place]})
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        assert within(5.0, lambda: not self.controller.state().laser_on)
        session.send("Emulation.setPageScaleFactor", {"pageScaleFactor": 1})
        session.detach()


def test_laser_off_works_in_every_state_of_the_page(desk, sized, served):
    page = sized
    off = LaserOff(page, served)
    press(page, "connect")
    says(page, "connected: Grbl")
    # The stage stays at rest, and nothing but the button talks to it.
    press(page, "stop")
    tab(page, "Stage")
    press(page, "unlock")
    says(page, "unlocking done")
    for name in TABS:
        tab(page, name)
        off.works(f"tab-{name}")
    page.get_by_label("colour").click()
    page.get_by_role("option", name="intensity").wait_for()
    off.works("choice")
    if page.get_by_role("dialog").count():
        page.get_by_role("option", name="intensity").click()
    page.get_by_role("option", name="intensity").wait_for(state="hidden")
    tab(page, "Files")
    page.get_by_role("button", name="about", exact=True).first.click()
    page.get_by_role("dialog").get_by_role("button", name="close").wait_for()
    off.works("about")
    assert page.get_by_role("dialog").is_visible()
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    off.works("about-scrolled")
    # The listener repeats Ctrl-X until the server has answered the last press: steady light shows that it has.
    light(served.controller)
    suspend(desk.process.pid)
    try:
        off.works("server-stands-still")
    finally:
        os.kill(desk.process.pid, signal.SIGCONT)
    press(page, "close")
    off.works("dialog-closed")
    if page.viewport_size["width"] < 1000:
        off.works_zoomed()
    # Before the page's scripts are loaded.
    page.route(re.compile("nicegui.js"), lambda route: held.append(route))
    held: list[Route] = []
    page.reload(wait_until="commit")
    page.locator("#laser-off").wait_for()
    off.works("loading")
    assert held
    for route in held:
        route.continue_()
    page.get_by_role("tab", name="Connect").wait_for()
    off.works("reloaded")
    assert len(off.states) == len(TABS) + 7
    light(served.controller)
    page.locator("#laser-off").focus()
    page.keyboard.press("Enter")
    assert dark(served)


@pytest.mark.slow
def test_a_camera_whose_cable_is_pulled_ends_the_scan_and_is_connected_again(desk, page, served):
    connected(page)
    tab(page, "Scan")
    page.get_by_label("positions").fill("16")
    press(page, "start")
    shows(page, "of 16")
    served.camera.disconnect()
    try:
        says(page, "check power and cable")
        assert dark(served)
    finally:
        served.camera.connect()
    tab(page, "Connect")
    press(page, "connect")
    page.locator(".log").get_by_text("connected: Grbl").nth(1).wait_for()
    tab(page, "Stage")
    press(page, "home")
    page.locator(".log").get_by_text("homing done").nth(1).wait_for()
    tab(page, "Scan")
    press(page, "continue interrupted")
    says(page, "wrote scan.h5")
    with Capture(desk.folder / "scan.h5") as scan:
        assert len(scan) == 16


def test_what_is_typed_before_the_page_is_connected_is_kept(desk, chromium):
    """The socket comes after the page, on a slow network much later."""
    with watched(chromium.new_page()) as page:
        page.set_default_timeout(SLOW_MS)
        sockets: list[WebSocketRoute] = []
        page.route_web_socket(re.compile("nicegui"), lambda socket: sockets.append(socket))
        page.goto(desk.operator_address)
        typed = {"camera": f"replay:{desk.folder / 'none.h5'}", "stage": "", "exposure, ms": "7"}
        for label, text in typed.items():
            page.get_by_label(label, exact=True).fill(text)
        sockets[0].connect_to_server()
        press(page, "connect")
        says(page, "none.h5")
        assert {label: page.get_by_label(label, exact=True).input_value() for label in typed} == typed


@pytest.mark.slow
def test_a_recorded_capture_is_shown_like_a_camera(desk, page, folder):
    sensor_file = desk.folder / "sensor.toml"
    write_scan(desk.folder / "old.h5", sensor_file)
    page.get_by_label("camera").fill(f"replay:{desk.folder / 'old.h5'}")
    page.get_by_label("stage").fill("")
    tab(page, "Connect")
    press(page, "connect")
    says(page, "no stage is connected")
    page.locator('img[src^="picture.jpg"]').wait_for()
    says(page, "all 3 images of")
    shows(page, "no laser")


def test_viewers_look_and_have_no_control(desk, page, chromium, served):
    connected(page)
    with watched(chromium.new_page()) as other:
        other.set_default_timeout(SLOW_MS)
        other.goto(desk.address)
        # A late viewer has a picture within 2 s of the page.
        other.locator('img[src^="picture.jpg"]').wait_for(timeout=2000)
        assert other.get_by_role("button", name="Laser off").count() == 0
        assert [each.inner_text() for each in other.get_by_role("button").all()] == ["FIT"]
        other.keyboard.press("Escape")
        tab(page, "Stage")
        press(page, "move")
        says(other, "homing done")
        assert other.locator(".log").get_by_text("by hand").count() == 0


@pytest.mark.slow
def test_mistakes_are_said_and_cost_nothing(desk, page, served):
    tab(page, "Scan")
    assert page.get_by_role("button", name="start", exact=True).is_disabled()
    tab(page, "Connect")
    page.get_by_label("camera").fill("gige:nowhere")
    press(page, "connect")
    says(page, "error: ")
    shows(page, "not connected")
    page.get_by_label("camera").fill("")
    press(page, "connect")
    says(page, "give the camera's address")
    page.get_by_label("camera").fill(served.camera.address)
    (desk.folder / "taken.h5").write_bytes(b"a capture")
    connected(page)
    tab(page, "Scan")
    for name, words in (("taken", "taken.h5 exists"), ("../away", "is not a name for a file"), ("", "is not a name")):
        page.get_by_label("name of the capture").fill(name)
        press(page, "start")
        says(page, words)
    assert (desk.folder / "taken.h5").read_bytes() == b"a capture"
    page.get_by_label("name of the capture").fill("scan")
    for positions in ("0", "2.5"):
        page.get_by_label("positions").fill(positions)
        press(page, "start")
        says(page, f"count: .*found {positions}")
    tab(page, "Measure")
    press(page, "length")
    says(page, "click two points")


@pytest.mark.slow
def test_keys_alone_are_enough(desk, page):
    def focused(text: str) -> None:
        for _ in range(60):
            page.keyboard.press("Tab")
            words, role = page.evaluate("[document.activeElement.innerText, document.activeElement.role]")
            if words.strip().lower() == text and role != "tab":
                return
        raise AssertionError(f"{text} is not reached")

    page.get_by_role("button", name="connect", exact=True).wait_for()
    focused("connect")
    page.keyboard.press("Enter")
    says(page, "connected: Grbl")
    page.locator(".cloud-view").focus()
    page.keyboard.press("ArrowLeft")


@pytest.mark.slow
def test_who_looks_closer_sees_all_points_there(desk, page):
    """The cloud has twice as many points as are shown."""
    rng = np.random.default_rng(3)
    points = np.column_stack([*rng.uniform(-100, 100, (2, 600_000)), rng.normal(400, 0.1, 600_000)])
    none = np.full(len(points), -1)
    cloud = uwlts.PointCloud(points, np.ones(len(points)), none, none)
    cloud.save(desk.folder / "plate.cloud.h5")
    tab(page, "Files")
    page.get_by_role("button", name="show", exact=True).click()
    page.locator(".cloud-view[data-points]").wait_for()
    view = page.locator(".cloud-view")
    view.focus()
    with page.expect_response(lambda answer: "cloud/detail" in answer.url) as got:
        for _ in range(9):
            view.press("+")
    page.locator(".cloud-view[data-detail]").wait_for()
    low, high = np.array(got.value.url.partition("box=")[2].split(","), float).reshape(2, 3)
    # Again, because Playwright waits without limit for the body of an answer to a page.
    again = page.request.get(got.value.url, timeout=SLOW_MS)
    sent = np.frombuffer(again.body(), "<f4").reshape(-1, 7)
    inside = np.all((points >= low) & (points <= high), axis=1)
    assert 0 < len(sent) == np.count_nonzero(inside) < len(points) / 4
    kept(page, "closer")
    view.press("f")
    page.locator(".cloud-view:not([data-detail])").wait_for()


@pytest.mark.slow
def test_a_second_operator_and_a_reload_leave_a_scan_alone(desk, page, chromium, served):
    """Both pages control the same scan, and both say what happens."""
    scanning(page)
    with watched(chromium.new_page()) as other:
        other.set_default_timeout(SLOW_MS)
        other.goto(desk.operator_address)
        shows(other, "of 60")
        for name, button in (("Scan", "start"), ("Stage", "home")):
            tab(other, name)
            assert other.get_by_role("button", name=button, exact=True).is_disabled()
        page.reload()
        shows(page, "of 60")
        tab(other, "Scan")
        press(other, "pause")
        says(page, "paused, the laser is off")
        assert dark(served)
        tab(page, "Scan")
        press(page, "resume")
        says(other, "wrote scan.h5")
        with Capture(desk.folder / "scan.h5") as scan:
            assert len(scan) == 60
        press(other, "start")
        says(page, "scan.h5 exists")


@pytest.mark.slow
def test_ctrl_c_ends_a_scan_in_the_dark(desk, page, served):
    scanning(page)
    assert desk.end()[0] == 0
    assert dark(served) and part_path(desk.folder / "scan.h5").is_file()


@pytest.mark.slow
def test_a_folder_that_is_not_there_is_refused(tmp_path):
    done = in_process.uwlts("desk", tmp_path / "nowhere")
    assert done.returncode != 0 and "there is no folder" in done.stderr and "Traceback" not in done.stderr
