"""Findings of `uwlts doctor`, each in a condition that really exists: nothing of the machine is mocked."""

import os
import re
import shlex
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import pytest
from packaging.requirements import Requirement

from tests.system.in_process import uwlts
from twin.devices.grbl_controller import BENCH_SETTINGS, GrblController
from uwlts import doctor as machine
from uwlts.doctor import Finding, examine_renderer
from uwlts.errors import SetupError
from uwlts.runtime import optional_library
from uwlts.runtime.optional_library import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
NOBODY = 65534


def other_than_progress(stderr: str) -> list[str]:
    """Return the lines that are not progress. A slow machine prints one of progress every ten seconds."""
    return [line for line in stderr.splitlines() if not re.fullmatch(r"examine.*: \d+ of \d+ after \d+ s", line)]


def doctor(*arguments: str, folder: Path, **environment: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "uwlts", "doctor", *arguments]
    return subprocess.run(command, cwd=folder, env=os.environ | environment, capture_output=True, text=True, timeout=60)


def as_nobody(program: str) -> str:
    """Output of a program that gives up administrator rights after its imports."""
    start = f"""
        import os
        from uwlts.doctor import examine_ports
        if os.geteuid() == 0:
            os.setgroups([])
            os.setresgid({NOBODY}, {NOBODY}, {NOBODY})
            os.setresuid({NOBODY}, {NOBODY}, {NOBODY})
    """
    command = [sys.executable, "-c", textwrap.dedent(start) + textwrap.dedent(program)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


# The command


def assert_all_is_examined(said: str) -> None:
    without_aravis = re.search(r"^ ?optional +Aravis", said, re.MULTILINE)
    for subject in (
        "Python",
        "required libraries",
        "libLLVM",
        "Aravis",
        "serial port",
        *([] if without_aravis else ["camera"]),
    ):
        assert re.search(rf"^ ?(ok|optional|warning) +{subject}", said, re.MULTILINE), subject


@pytest.mark.slow
def test_a_machine_on_which_the_tests_run_lacks_nothing_required(tmp_path):
    ended = doctor(folder=tmp_path)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert not other_than_progress(ended.stderr)
    assert "nothing that is required is missing" in ended.stdout
    assert_all_is_examined(ended.stdout)


def test_a_broken_library_ends_in_exit_code_1_without_a_traceback(tmp_path):
    (tmp_path / "numpy").mkdir()
    (tmp_path / "numpy" / "__init__.py").write_text("raise ImportError('truncated on the way')\n")
    ended = doctor(folder=tmp_path, PYTHONPATH=f"{tmp_path}:{ROOT}")
    assert ended.returncode == 1
    assert "Traceback" not in ended.stdout + ended.stderr
    said = re.sub(r"\s+", " ", ended.stdout)
    # Without it the cameras cannot be examined; the ports below them are.
    assert "a part was left out: truncated on the way" in said and "serial port" in said
    assert "install again the library that failed" in said


def test_devices_that_are_named_and_missing_end_in_exit_code_1(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = uwlts("doctor", "--camera", "replay:nothing", "--stage", tmp_path / "tty")
    assert ended.returncode == 1 and not other_than_progress(ended.stderr)
    # Nothing else is missing.
    assert "missing: camera, stage; " in ended.stdout
    assert_all_is_examined(ended.stdout)
    assert "there is no such port" in re.sub(r"\s+", " ", ended.stdout)


# Libraries


def test_python_is_compared_with_what_is_required():
    assert machine.examine_python(">=3.11").status == "ok"
    too_old = machine.examine_python(">=99")
    assert too_old.status == "missing" and "needed is >=99" in too_old.found and "install Python" in too_old.advice


def test_the_requirements_are_the_projects_own():
    python, required, extras = optional_library.read_requirements()
    assert python == ">=3.11"
    assert {"numpy", "rich", "optuna"} <= {Requirement(line).name for line in required}
    assert "dask" in {Requirement(line).name for lines in extras.values() for line in lines}


def test_an_installed_package_lists_its_requirements_without_a_checkout(tmp_path):
    face = [
        ROOT / "uwlts" / name
        for name in ("__init__.py", "__init__.pyi", "_version.py", "argument_types.py", "errors.py", "doctor.py")
    ]
    progress = [ROOT / "uwlts" / "runtime" / name for name in ("__init__.py", "optional_library.py", "progress.py")]
    for source in [*face, *progress]:
        copy = tmp_path / source.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(source.read_bytes())
    (tmp_path / "uwlts-9.dist-info").mkdir()
    (tmp_path / "uwlts-9.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.4\nName: uwlts\nVersion: 9\nRequires-Python: >=3.11\nRequires-Dist: numpy>=2\n"
        "Requires-Dist: winonly; sys_platform == 'win32'\nRequires-Dist: laspy>=2; extra == 'clouds'\n"
        "Requires-Dist: anything; extra == 'test'\n"
    )
    program = "from uwlts.doctor import read_requirements; print(read_requirements())"
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == str(
        (">=3.11", ["numpy>=2"], {extra: [] for extra in EXTRAS} | {"clouds": ["laspy>=2"]})
    )


def test_every_kind_of_missing_library_is_named():
    found = machine.examine_required(["numpy>=2", "pydantic>=999", "no-such-library-of-ours>=1"])
    version = metadata.version("pydantic")
    assert [each.status for each in found] == ["ok", "missing", "missing"]
    assert found[0].found == f"numpy {metadata.version('numpy')}"
    assert found[1].found == f"{version} is installed, >=999 is needed"
    assert found[1].advice.endswith("-m pip install 'pydantic>=999'")
    assert found[2].found == "not installed"


def test_absent_optional_libraries_are_optional_and_old_ones_a_warning():
    extras = {"xyz": ["no-such-library-of-ours>=2", "pytest>=8"], "there": ["pytest"], "old": ["pytest>=999"]}
    purposes = {"xyz": "clouds as XYZ", "there": "tests", "old": "tests"}
    absent, there, old = machine.examine_optional(extras, purposes)
    version = metadata.version("pytest")
    assert absent.status == "optional"
    assert absent.found == f"no-such-library-of-ours not installed, pytest {version}; for clouds as XYZ"
    assert "only for clouds as XYZ" in absent.advice
    assert absent.advice.endswith("-m pip install 'no-such-library-of-ours>=2' 'pytest>=8'")
    assert there == Finding("there", "ok", f"pytest {version}; for tests")
    assert old.status == "warning" and ">=999 is needed" in old.found


def test_every_extra_for_users_is_examined():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert extras.keys() - EXTRAS.keys() == {"docs", "test", "mutants", "results"}
    assert EXTRAS.keys() <= extras.keys()


def test_a_missing_library_is_named_with_a_command_that_works_without_an_index_of_this_project():
    with pytest.raises(SetupError) as caught:
        optional_library.optional_library("no_such_library", needed_by="LAZ", extra="clouds", instead=", or write PLY")
    pattern = r"LAZ needs the library no-such-library, .*: \S+ -m pip install (.*), or write PLY$"
    found = re.search(pattern, str(caught.value))
    assert found is not None
    lines = map(Requirement, optional_library.read_requirements()[2]["clouds"])
    applying = [str(line).partition(";")[0] for line in lines if line.marker is None or line.marker.evaluate()]
    assert [str(Requirement(word)) for word in shlex.split(found[1])] == applying
    assert "uwlts[" not in str(caught.value)


def test_an_invalid_libllvm_gives_a_warning_with_the_install_command(tmp_path, monkeypatch):
    (tmp_path / "libLLVM.so").write_text("not a library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so"))
    (finding,) = examine_renderer()
    assert finding.status == "warning" and str(tmp_path) in finding.found
    assert finding.advice.endswith("-m twin.backend.llvm")


# Devices


def test_an_aravis_that_does_not_load_is_a_warning_that_says_how_to_get_it(tmp_path):
    (tmp_path / "libaravis.so").write_text("not a library")
    program = "from uwlts.doctor import examine_cameras; print(*examine_cameras(), sep='\\n')"
    ended = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=os.environ | {"UWLTS_LIBARAVIS": str(tmp_path / "libaravis.so")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stdout.count("Finding(") == 1 and "status='warning'" in ended.stdout
    assert str(tmp_path) in ended.stdout and "apt-get install libaravis" in ended.stdout


def test_a_port_that_this_user_may_not_open_is_a_warning_with_the_command():
    # A terminal like the port of a stage: owned by root, open to a group without members.
    program = """
        port = os.ttyname(os.openpty()[1])
        print(examine_ports([port])[0])
        os.chmod(port, 0o060)
        print(examine_ports([port])[0])
        os.chmod(port, 0o000)
        print(examine_ports([port])[0])
    """
    usable, of_a_group, of_none = as_nobody(program).splitlines()
    assert "status='ok'" in usable
    assert "status='warning'" in of_a_group and re.search(r"sudo usermod -aG \w+ \$USER", of_a_group)
    assert "status='warning'" in of_none and "sudo chgrp dialout /dev/pts/" in of_none


def test_a_port_that_is_gone_is_a_warning():
    assert machine.examine_ports(["/dev/ttyNone"])[0].found == "/dev/ttyNone is not there"
    assert machine.examine_ports([])[0].found == "none"


# A camera


def images(folder: Path, grey: int, count: int = 12) -> str:
    folder.mkdir()
    for number in range(count):
        assert cv2.imwrite(str(folder / f"{number}.png"), np.full((48, 64), grey, np.uint8))
    return f"replay:{folder}"


def test_ten_frames_are_taken_and_judged(tmp_path):
    (good,) = machine.try_camera(images(tmp_path / "good", 51))
    assert good.status == "ok" and "64 x 48 px of 8 bit" in good.found
    # 51 of 255.
    assert "10 frames" in good.found and good.found.endswith("mean grey value 20.0 % of full scale")
    (white,) = machine.try_camera(images(tmp_path / "white", 255))
    assert white.status == "warning" and "saturated" in white.advice
    (black,) = machine.try_camera(images(tmp_path / "black", 0))
    assert black.status == "warning" and "lens cap" in black.advice


def test_a_camera_that_does_not_give_ten_frames_is_missing(tmp_path):
    (short,) = machine.try_camera(images(tmp_path / "few", 51, count=9))
    assert short.status == "missing" and "all 9 images" in short.found
    (unknown,) = machine.try_camera("webcam:0")
    assert unknown.status == "missing" and "is not a camera address" in unknown.found
    assert "gige:NAME" in unknown.advice


# A stage


@contextmanager
def unmoved(**options: object) -> Iterator[GrblController]:
    """A controller whose log shows that the stage did not move and the laser stayed off."""
    with GrblController(position_mm=30.0, boot_s=0.1, **options) as controller:
        yield controller
        state = controller.state()
        assert (state.position_mm, state.moving, state.laser_on) == (30.0, False, False)


def test_the_settings_are_those_of_the_documentation():
    text = (ROOT / "docs" / "how-to" / "hardware-stage.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| `$")]
    documented = {int(number): float(value) for row in rows for number, value in re.findall(r"`\$(\d+)=(\d+)`", row)}
    assert len(documented) > 15
    examined = {number: value for number, (value, _) in machine.BEHAVIOUR.items()} | machine.MECHANICS
    assert examined == documented
    assert machine.judge_settings(BENCH_SETTINGS)[0].status == "ok"


def test_a_stage_as_documented_is_in_order():
    with unmoved() as controller:
        build, settings, state, laser = machine.try_stage(controller.port)
    assert build.found == f"{controller.port}: Grbl 1.1h, options V"
    assert [each.status for each in (build, settings, state, laser)] == ["ok"] * 4
    assert "NOT if program and guard are killed" in laser.found
    assert state.found == "locked until it is homed, as after every start"


def test_settings_that_contradict_the_documentation_are_named():
    with unmoved(settings={1: 25, 32: 0, 100: 250}) as controller:
        _, behaviour, mechanics, *_ = machine.try_stage(controller.port)
    assert behaviour.status == mechanics.status == "warning"
    assert behaviour.found.startswith("$1 is 25, not 255") and "$32 is 0, not 1" in behaviour.found
    assert behaviour.advice.endswith(": $1=255 $32=1")
    assert mechanics.found.endswith(": $100 is 250") and mechanics.advice.endswith("$100=80")


def test_a_stage_without_a_switch_is_explained():
    with unmoved(settings={20: 0, 22: 0}) as controller:
        _, settings, state, _ = machine.try_stage(controller.port)
    assert "without a limit switch" in settings.advice
    assert (state.status, state.found) == ("ok", "idle")


def test_an_alarm_silence_and_a_firmware_that_cannot_switch_the_laser_are_missing():
    with unmoved(options="") as controller:
        assert "without V" in machine.try_stage(controller.port)[0].found
    with unmoved() as controller:
        controller.inject("mute")
        (silent,) = machine.try_stage(controller.port)
    assert silent.status == "missing" and "nothing answers" in silent.found
    assert "docs/how-to/hardware-stage.md" in silent.advice


def test_a_pressed_switch_is_a_warning():
    with GrblController(position_mm=-0.1, boot_s=0.1) as controller:
        state = machine.try_stage(controller.port)[2]
    assert state.status == "warning" and "X are active" in state.found and "limit switch is pressed" in state.advice
