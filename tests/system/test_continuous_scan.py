"""Scans without stops over real protocols: positions of frames, latency, and refusals."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import uwlts
from tests.system.drawn_hardware import HEIGHT_PX, WIDTH_PX, write_plan
from twin.devices.gige_camera import ExposedFrame, GigeCamera
from twin.devices.grbl_controller import GrblController, StageState
from uwlts.errors import DescriptionError, EvaluationError, HardwareError, RangeError
from uwlts.hardware import continuous
from uwlts.reconstruction.latency import measure_latency
from uwlts.storage.capture import Capture

TRAVEL_MM, STEPS_PER_MM = 300.0, 100
STAGE = {24: 600, 25: 7200, 100: STEPS_PER_MM, 110: 7200, 120: 2000, 130: TRAVEL_MM}
SPEED, STEP_MM, COUNT, START_MM = 100.0, 1.0, 121, 90.0
ENCODER_MM = 1 / STEPS_PER_MM


def surface(position_mm: float) -> np.ndarray:
    """Stripe position of each line in px: a hill 30 mm wide."""
    away = (position_mm - 150.0 - 0.05 * np.arange(WIDTH_PX)) / 12.0
    return 250.0 + 120.0 * np.exp(-(away**2))


class Hill:
    """A free-running camera before a hill; ``states`` are the true ones in the middle of the exposures."""

    def __init__(self, controller: GrblController):
        self.controller, self.states, self.lit = controller, [], True
        self._rng = np.random.default_rng(2)
        self.camera = GigeCamera(
            lambda exposure_ms: self._drawn(controller.state()),
            width_px=WIDTH_PX,
            height_px=HEIGHT_PX,
            encoder=controller.steps,
            expose=self._expose,
        )

    def _expose(self) -> ExposedFrame:
        state = self.controller.state()
        self.states.append(state)
        return ExposedFrame(state.time_s, self.controller.steps(state), lambda exposure_ms: self._drawn(state))

    def _drawn(self, state: StageState) -> np.ndarray:
        image = self._rng.normal(6.0, 1.0, (HEIGHT_PX, WIDTH_PX))
        if state.laser_on and self.lit:
            away = np.arange(HEIGHT_PX)[:, None] - surface(state.position_mm)
            image += 160.0 * np.exp(-0.5 * (away / 2.0) ** 2)
        return np.clip(image, 0, 255).astype(np.uint8)


@pytest.fixture
def hill() -> Iterator[Hill]:
    with GrblController(settings=STAGE) as controller:
        drawn = Hill(controller)
        with drawn.camera:
            yield drawn


def plan(folder: Path, hill: Hill, moving: str, *, count: int = COUNT) -> Path:
    path = write_plan(folder, hill.camera, hill.controller, count=count, step_mm=STEP_MM)
    text = path.read_text().replace("[stage]", f"check_steps = false\ncontinuous = {{ {moving} }}\n[stage]")
    path.write_text(text.replace("start_mm = 5.0", f"start_mm = {START_MM}"))
    sensor = folder / "sensor.toml"
    sensor.write_text(sensor.read_text().replace("travel_mm = 120.0", f"travel_mm = {TRAVEL_MM}"))
    return path


def true_places(capture: Capture, hill: Hill) -> np.ndarray:
    """True positions of the frames: those of the nearest exposures in time, with a common offset.

    For regular exposures, offsets by whole frames fit equally well. The offset closest to the capture's own positions
    counts, because no error in question is a whole frame.
    """
    times = np.array([state.time_s for state in hill.states])
    places = np.array([state.position_mm for state in hill.states])
    # Times of the capture start at its beginning, on the host's clock. The camera's clock was compared with it.
    offsets = times[:, None] - capture.time_s
    # The first frame is one of the exposures.
    candidates = np.sort(offsets[:, 0])
    off = np.array([np.abs(offsets - by).min(axis=0).max() for by in candidates])
    fitting = candidates[off < 1e-6]
    assert len(fitting)
    found = [places[np.abs(offsets - by).argmin(axis=0)] for by in fitting]
    return min(found, key=lambda there: np.abs(there - capture.stage_mm).max())


@pytest.mark.slow
def test_frames_are_where_the_stage_was_whatever_the_clocks_differ_by(hill, tmp_path, monkeypatch):
    usual, said = continuous._compare_clocks, []

    def compared(*about, **settings):
        clock = usual(*about, **settings)
        return clock[0] + 0.02, clock[1]

    monkeypatch.setattr(continuous, "_compare_clocks", compared)
    moving = f"speed_mm_per_s = {SPEED}"
    seen = uwlts.scan(plan(tmp_path, hill, moving), tmp_path / "a.h5", home=True, report=said.append)
    assert not hill.controller.state().laser_on
    with Capture(tmp_path / "a.h5") as capture:
        # A busy machine makes fewer frames.
        assert capture.moving and 20 < len(capture) <= 2 * COUNT + 4 and seen.found > 0.95 * seen.lines
        assert np.allclose(np.abs(capture.speed_mm_per_s), SPEED, rtol=0.01)
        assert {1.0, -1.0} == set(np.sign(capture.speed_mm_per_s)) and len(capture.stage_reports) > 10
        assert "measured" in said[-1]
        error_s = (capture.stage_mm - true_places(capture, hill)) / capture.speed_mm_per_s
        scatter_s = float(said[-1].split("scatter by ")[1].split(" ms")[0]) * 1e-3
        # 0.2 ms; on a busy machine five standard errors of a pass's position from its reports, at least four.
        allowed_s = max(2e-4, 5 * scatter_s / np.sqrt(4))
        assert np.abs(error_s).max() < allowed_s


@pytest.mark.parametrize("set_s", [-37.0, 0.2])
def test_a_camera_s_clock_that_is_set_on_the_way_is_noticed(hill, tmp_path, monkeypatch, set_s):
    """As by PTP, when the network finds its time."""
    usual, count = hill.camera._expose, [0]

    def off_s() -> float:
        return set_s * (count[0] > COUNT // 2)

    def later() -> ExposedFrame:
        count[0] += 1
        shot = usual()
        return replace(shot, middle_s=shot.middle_s + off_s())

    # Stamps of free-running and of triggered frames.
    monkeypatch.setattr(hill.camera, "_expose", later)
    monkeypatch.setattr(time, "monotonic_ns", lambda: round(1e9 * (time.monotonic() + off_s())))
    with pytest.raises(HardwareError, match="clock"):
        uwlts.scan(plan(tmp_path, hill, f"speed_mm_per_s = {SPEED}"), tmp_path / "a.h5", home=True)
    assert not hill.controller.state().laser_on


@pytest.mark.slow
def test_an_encoder_places_the_frames_without_any_clock(hill, tmp_path):
    moving = f"speed_mm_per_s = {SPEED}, both_ways = false, mm_per_count = {ENCODER_MM}"
    warned = []
    uwlts.scan(plan(tmp_path, hill, moving), tmp_path / "a.h5", home=True, warn=warned.append)
    with Capture(tmp_path / "a.h5") as capture:
        # A count is a step of 0.01 mm.
        assert np.abs(capture.stage_mm - true_places(capture, hill)).max() <= 0.5 * ENCODER_MM + 1e-6
        # A busy machine makes fewer frames.
        assert all("frames were lost" in each for each in warned)


@pytest.mark.slow
def test_a_way_alone_says_that_its_latency_is_not_known(hill, tmp_path):
    warned = []
    moving = f"speed_mm_per_s = {SPEED}, both_ways = false"
    uwlts.scan(plan(tmp_path, hill, moving), tmp_path / "a.h5", home=True, warn=warned.append)
    assert any("latency of the stage is unknown" in text for text in warned)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moving", "error", "words"),
    [
        ("speed_mm_per_s = 130.0", RangeError, "stage does at most 120 mm/s"),
        ("speed_mm_per_s = -1.0", DescriptionError, "speed_mm_per_s"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_moves(hill, tmp_path, moving, error, words):
    with pytest.raises(error, match=words):
        uwlts.scan(plan(tmp_path, hill, moving), tmp_path / "a.h5", home=True)
    assert not hill.states


@pytest.mark.slow
def test_a_way_too_long_for_its_ramps_and_a_dark_laser_are_errors(hill, tmp_path):
    with pytest.raises(RangeError, match=r"with 33.5 mm to reach 100 mm/s the stage would go from 56.5 to"):
        uwlts.scan(plan(tmp_path, hill, "speed_mm_per_s = 100.0", count=180), tmp_path / "a.h5", home=True)
    hill.lit = False
    with pytest.raises(HardwareError, match="no stripe in any of"):
        uwlts.scan(plan(tmp_path, hill, "speed_mm_per_s = 100.0"), tmp_path / "b.h5", home=True)
    assert not hill.controller.state().laser_on


def test_the_latency_of_drawn_passes_and_what_does_not_show_it():
    rng, speed, latency = np.random.default_rng(8), 80.0, -0.0123
    # The hill is surrounded by flat ground, which matches itself at any shift.
    places = np.concatenate([np.arange(90, 211.0), np.arange(210.4, 89, -1.0)])
    signed = np.where(np.arange(len(places)) < 121, speed, -speed)
    truth = places + signed * latency
    centres = np.array([surface(place) for place in truth]) + rng.normal(0, 0.05, (len(places), WIDTH_PX))
    found, std = measure_latency(centres, places, signed)
    # 0.05 px of noise on some 40 x 96 points of the hill with slopes of up to 8 px/mm.
    assert std < 1e-5 and abs(found - latency) < max(5 * std, 2e-6)
    with pytest.raises(EvaluationError, match="forward and 0 of the backward pass"):
        measure_latency(centres, places, np.abs(signed))
    with pytest.raises(EvaluationError, match="relief"):
        measure_latency(np.full_like(centres, 200.0), places, signed)
    # A busy camera takes every fourth frame: the stripe moves by 10 px and more a frame, and bends by 13 at the top.
    coarse, std = measure_latency(centres[::4], places[::4], signed[::4])
    # The error of Hermite's cubic through central differences, at most 0.2 px/mm wrong at 4 mm, is about 0.1 px.
    assert std < 2e-5 and abs(coarse - latency) < 2e-4
