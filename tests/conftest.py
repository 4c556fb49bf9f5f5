"""Select Mitsuba's variant before any test module imports the renderer, and load the sensor used by most tests."""

import ctypes
import fcntl
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
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
    "test_calibrate_live.py",
    "test_scan_command.py",
    "test_scan_3d.py",
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

NICE = 15
"""Niceness of test processes other than the serving one, which checks times."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Distribute whole files to processes; all files that serve run in the same one, so that they do not wait."""
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return "serving" if Path(file).name in SERVING else file

    return ByFile(config, log)


@pytest.fixture(scope="module", autouse=True)
def serving_alone(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let only one test process serve cameras and pages; the others run at lower priority."""
    if request.path.name not in SERVING:
        if "PYTEST_XDIST_WORKER" in os.environ:
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
