"""Select Mitsuba's variant before any test module imports the renderer, and load the sensor used by most tests."""

import ctypes
import fcntl
import gc
import os
import signal
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.browser import find_chromium, open_chromium
from twin.rendering_options import CPU, use_variant
from uwlts.errors import SetupError
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).resolve().parent.parent

use_variant(os.environ.get("TWIN_TEST_VARIANT", CPU))

# Processes that tests start in other folders find the packages as this one does.
os.environ["PYTHONPATH"] = str(ROOT)
# Views of clouds open no window on the developer's screen: the program `true` is the browser.
os.environ["BROWSER"] = "true"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--noise", type=int, default=0, help="draw all noise again: another number, other noise (0: the usual)"
    )
    parser.addoption(
        "--lanes", type=int, default=0, help="vectors in the renderer's kernels as of another processor: 4, 8 or 16"
    )


def pytest_configure(config: pytest.Config) -> None:
    number = config.getoption("--noise")
    if number:
        folder = str(ROOT / "tests" / "other_noise")
        os.environ |= {"TEST_NOISE": str(number), "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
        sys.path.insert(0, folder)
        # A worker process has imported it at its start.
        if not hasattr(sys.modules.get("sitecustomize"), "change_mitsuba"):
            sys.modules.pop("sitecustomize", None)
        import sitecustomize

        sitecustomize.change_mitsuba()
    if lanes := config.getoption("--lanes"):
        use_lanes(lanes)


def use_lanes(count: int) -> None:
    """Compile this process's kernels for vectors of ``count`` numbers: 4 as for SSE, 8 for AVX2, 16 for AVX-512."""
    import drjit

    drjit.eval(drjit.llvm.Float(0.0))  # starts LLVM, which takes the processor's own
    library = ctypes.CDLL(str(Path(drjit.__file__).parent / "libdrjit-core.so"))
    # No part of Dr.Jit's Python interface: jit_llvm_set_target(const char *, const char *, uint32_t).
    library._Z19jit_llvm_set_targetPKcS0_j(b"haswell", b"+avx2,+fma", count)


# Shells start background jobs with SIGINT ignored, and children inherit this. The tests need Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

# These tests serve cameras and pages at fixed ports of this machine, or search for
# them: only one of these tests can run at a time.
SERVING = {
    "test_desk.py",
    "test_desk_analyses.py",
    "test_desk_calibration.py",
    "test_desk_screens.py",
    "test_serve.py",
    "test_gige_camera.py",
    "test_scan_command.py",
    "test_continuous_scan.py",
    "test_scan_exposure.py",
    "test_scan_ended.py",
    "test_scan_faults.py",
    "test_light.py",
    "test_live_view.py",
    "test_cameras.py",
    "test_doctor.py",
    "test_documented_hardware.py",
}

# These tests check times of some tenths of a second, and mostly wait.
TIMED = {"test_grbl.py", "test_laser_guard.py", "test_laser_off_attacked.py"}

# The longest of the others, which start first: at the end no process waits for a long file.
LONG = (
    "test_documented_commands.py",
    "test_sweep.py",
    "test_thesis_edition.py",
    "test_real_images.py",
    "test_fuzz.py",
    "test_against_stock.py",
    "test_experiment.py",
    "test_generation.py",
    "test_lens.py",
    "test_coverage.py",
    "test_mount.py",
    "test_desk_measured.py",
    "test_align.py",
    "test_page_access.py",
)

NICE = 15
"""Niceness of test processes that check no times."""


def group(path: Path) -> str:
    """Return the group of a file: groups run in one process each. Only files that serve or check times share one."""
    return "serving" if path.name in SERVING else "timed" if path.name in TIMED else str(path)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Begin collecting at another file in each test process, which then finds the bytecode that others have written.

    In a new checkout each would otherwise rewrite the assertions of all files. Imported modules and collected tests
    stay, so that garbage is sought beside them only.
    """
    work = getattr(session.config, "workerinput", None)
    if work and session.config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        files = sorted(str(path) for path in (ROOT / "tests").rglob("test_*.py"))
        start = len(files) * int(work["workerid"].removeprefix("gw")) // work["workercount"]
        session.config.args = files[start:] + files[:start]
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest groups."""
    first = ["serving", "timed", *LONG]
    ranks = {name: number for number, name in enumerate(first)}
    items.sort(key=lambda item: (ranks.get(Path(group(item.path)).name, len(first)), str(item.path)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Distribute groups of files to processes, so that none waits for another one's cameras."""
    from xdist.scheduler import LoadFileScheduling

    class ByGroup(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group(Path(super()._split_scope(nodeid)))

        def remove_node(self, node: Any) -> str | None:
            # Without this, the test that ended a process would run again, and end the next one.
            units = self.assigned_work[node].values()
            ended_by = next(((unit, test) for unit in units for test, done in unit.items() if not done), None)
            if ended_by is not None:
                unit, test = ended_by
                unit[test] = True
            super().remove_node(node)
            return ended_by and ended_by[1]

    return ByGroup(config, log)


@pytest.fixture(scope="module", autouse=True)
def serving_alone(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let only one test process serve cameras and pages; the others run at lower priority."""
    if request.path.name not in SERVING:
        if "PYTEST_XDIST_WORKER" in os.environ and request.path.name not in TIMED:
            os.nice(max(0, NICE - os.nice(0)))
        yield
        return
    with open(Path(tempfile.gettempdir()) / "uwlts-tests-serving.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session")
def thesis() -> Sensor:
    """Return the thesis's sensor according to its drawings."""
    return load_sensor("thesis")


@pytest.fixture(scope="session")
def thesis_as_built() -> Sensor:
    """The same sensor with distortion, tilted windows and a rolled sheet."""
    return load_sensor("thesis-as-built")


@pytest.fixture(scope="module")
def chromium() -> "Iterator[Browser]":
    """A headless Chromium with WebGL, as Playwright's Browser; without one the test fails.

    Playwright's event loop runs in this thread while the browser is open, so asyncio.run cannot be used. The browser is
    closed at the end of the module.
    """
    try:
        path = find_chromium()
    except SetupError as error:
        pytest.fail(str(error), pytrace=False)
    with open_chromium(path) as browser:
        yield browser
