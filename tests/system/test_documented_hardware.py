"""The documentation's pages on cameras and stages, run in their order with the twin as both."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.documented import ROOT
from tests.system.documented_runs import Page, Runner, run_page, write_small_descriptions
from tests.system.test_desk_calibration import SENSOR
from twin.devices.serve import ServedTwin, serve
from twin.scene.description import load_scene

pytestmark = pytest.mark.slow

CAMERA, STAGE = "gige:127.0.0.1", "/dev/stage"
"""The stage's pseudo terminal has another name each time: the served one takes the place of this."""
ADDRESSES = {"gige:192.168.1.10": CAMERA, "/dev/ttyACM0": STAGE}


def without_capture(runner: Runner) -> None:
    """The scan was interrupted before its first image."""
    (runner.folder / "scan.h5").unlink()


PAGES_RUN = {
    "docs/how-to/served-twin.md": Page(ready={"twin serve plane": "serving"}),
    "docs/how-to/hardware-camera.md": Page(
        # The twin delivers a frame when it is rendered.
        instead={"gige:192.168.1.20": CAMERA, "timeout_s=1.0": "timeout_s=60.0"}
    ),
    "docs/how-to/scan.md": Page(
        tables={"plan.toml": 0},
        texts={"sensor.toml": SENSOR},
        before="uwlts nominal sensor.toml --medium water --out calibration.json",
        instead=ADDRESSES
        | {
            '"mine.toml" ': '"sensor.toml" ',
            "bracket = [1, 4, 16] ": "bracket = [1, 4] ",
            "start_mm = 100.0 ": "start_mm = 198.0 ",
            "count = 300": "count = 4",
            "feed_mm_per_min = 300.0": "feed_mm_per_min = 900.0",
            "settle_s = 0.2": "settle_s = 0.0",
        },
        prepare={"uwlts scan plan.toml --home --out scan.h5 --resume": without_capture},
    ),
    "docs/how-to/desk.md": Page(
        tables={"plan.toml": 0, "tank/plan.toml": 0},
        texts={"tank/README": ""},
        ready={"twin serve spheres": "serving", "uwlts desk": "http"},
    ),
    "docs/how-to/calibrate-live.md": Page(texts={"tank/README": ""}, instead=ADDRESSES, ready={"uwlts desk": "http"}),
}
SERVED = {"docs/how-to/hardware-camera.md": "target", "docs/how-to/scan.md": "spheres"} | {
    "docs/how-to/calibrate-live.md": "target"
}
"""Scene that the twin shows beside a page; the others start it themselves."""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    write_small_descriptions(folder)
    (folder / "sensor.toml").write_text(SENSOR, encoding="utf-8")
    return folder


@pytest.fixture
def served(request: pytest.FixtureRequest, small: Path) -> Iterator[ServedTwin | None]:
    scene = SERVED.get(request.param)
    if scene is None:
        yield None
        return
    placement = "standoff" if scene == "spheres" else None
    described = load_scene(small / f"{scene}.toml", placement=placement)
    with serve(described, sensor=small / "sensor.toml", spp=2, speed_up=100.0) as running:
        yield running


@pytest.mark.parametrize(("name", "served"), [(name, name) for name in PAGES_RUN], indirect=["served"])
def test_page_runs_with_the_twin_as_hardware(name, served, small, tmp_path):
    how = PAGES_RUN[name]
    if served:
        instead = {word: other.replace(STAGE, served.controller.port) for word, other in how.instead.items()}
        how = Page(**{**vars(how), "instead": instead})
    run_page(ROOT / name, how, shared=None, folder=tmp_path, small=small, separate=True)
