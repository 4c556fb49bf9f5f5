"""Selection of a libLLVM for Dr.Jit: refusals, reports, and a kernel with the selected library.

Broken libraries are simulated by real ones: copies of a small library from Mitsuba's wheel. The name of a library that
it needs is overwritten with a name of the same length that exists on no system.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from twin.backend import llvm
from twin.backend.llvm import LlvmLibrary, check_library, find_llvm, list_candidates, main
from uwlts.errors import SetupError

NEEDED, ABSENT = b"libm.so.6\0", b"libQ.so.6\0"


@pytest.fixture(autouse=True)
def no_choice_by_the_user(monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)


@pytest.fixture(scope="module")
def machine_library():
    """The libLLVM that the installation provides; the tests' command sees to it that there is one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
        return find_llvm()


@pytest.fixture(scope="module")
def foreign_library():
    """A small shared library that loads but is no libLLVM."""
    return Path(importlib.util.find_spec("mitsuba").origin).with_name("libpugixml.so")


def overwrite_name(source, target):
    content = source.read_bytes()
    assert NEEDED in content and len(NEEDED) == len(ABSENT)
    target.write_bytes(content.replace(NEEDED, ABSENT))
    return target


def run_child(script, **environment):
    """Run a script in a new interpreter that has not imported drjit or mitsuba."""
    root = Path(__file__).parents[3]
    variables = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"} | environment
    return subprocess.run(
        [sys.executable, "-c", script], cwd=root, env=variables, capture_output=True, text=True, timeout=120
    )


def test_candidates_are_shared_libraries_named_llvm_each_once(tmp_path):
    for name in ("libLLVM.so.19.1", "libLLVM-15.so.1", "libLLVM.so.20.1-custom"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    for other in ("libLLVMCore.so.19.1", "libLLVMSupport.a", "libLTO.so.19.1", "libLLVM.sock"):
        (tmp_path / other).touch()
    (tmp_path / "libLLVM.so").mkdir()
    found = list_candidates([tmp_path, tmp_path / "missing", tmp_path])
    assert sorted(path.name for path in found) == ["libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM.so.20.1-custom"]


@pytest.fixture
def loaded(monkeypatch):
    """A function that has a library of a version, None for one without LLVMGetVersion, loaded instead of a file."""

    class Handle:
        def __init__(self, version):
            if version is not None:
                self.LLVMGetVersion = lambda *numbers: [
                    setattr(number._obj, "value", value) for number, value in zip(numbers, version, strict=True)
                ]

    return lambda version: monkeypatch.setattr(llvm.ctypes, "CDLL", lambda library: Handle(version))


@pytest.mark.parametrize("major", [14, 15, 16])
def test_versions_that_abort_are_refused(loaded, major):
    loaded((major, 0, 6))
    with pytest.raises(SetupError, match=rf"version {major}\.0\.6; version 17 or newer is needed"):
        check_library(Path("libLLVM.so"))


def test_library_without_version_function_is_refused_as_too_old(loaded):
    loaded(None)
    with pytest.raises(SetupError, match="too old"):
        check_library(Path("libLLVM.so"))


@pytest.mark.parametrize("major", [17, 19, 22, 23])
def test_newer_versions_are_accepted(loaded, major):
    loaded((major, 1, 2))
    assert check_library(Path("libLLVM.so")).version == (major, 1, 2)


def test_the_first_suitable_is_chosen_whatever_its_name_claims(tmp_path, monkeypatch):
    true_versions = {"first/libLLVM.so.22.1": 15, "first/libLLVM-16.so.1": 18, "second/libLLVM.so.20.1": 20}
    for name in true_versions:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    def state(path):
        version = true_versions[str(path.relative_to(tmp_path))]
        if version < 17:
            raise SetupError(f"{path}: too old")
        return LlvmLibrary(path, (version, 1, 0))

    monkeypatch.setattr(llvm, "check_library", state)
    assert find_llvm([tmp_path / "first", tmp_path / "second"]).path.name == "libLLVM-16.so.1"
    assert find_llvm([tmp_path / "second", tmp_path / "first"]).path.name == "libLLVM.so.20.1"


def test_message_lists_what_was_found_and_how_to_install(tmp_path, loaded):
    (tmp_path / "libLLVM-15.so.1").touch()
    (tmp_path / "libLLVM-14.so.1").touch()
    loaded((15, 0, 7))
    with pytest.raises(SetupError) as caught:
        find_llvm([tmp_path])
    message = str(caught.value)
    expected = (
        f"{tmp_path / 'libLLVM-15.so.1'}: version 15.0.7",
        f"{tmp_path / 'libLLVM-14.so.1'}: version",
        "LLVM 17 or newer",
        "apt-get install libllvm19",
        "dnf install llvm-libs",
        "pip install",
        "DRJIT_LIBLLVM_PATH",
    )
    assert [part for part in expected if part not in message] == []


def test_message_says_none_where_there_is_none(tmp_path):
    with pytest.raises(SetupError, match="Found:\n  none\n"):
        find_llvm([tmp_path])


def test_version_comes_from_the_library_not_from_its_name(tmp_path, machine_library, foreign_library):
    # A copy keeps the false name; a symbolic link would be resolved to the true one.
    folder = tmp_path / "lib"
    folder.mkdir()
    for beside in machine_library.path.parent.glob("*-linux-gnu"):
        (folder / beside.name).symlink_to(beside)
    shutil.copyfile(machine_library.path, folder / "libLLVM-15.so.1")
    shutil.copyfile(foreign_library, folder / "libLLVM.so.99.1")
    chosen = find_llvm([folder])
    assert chosen.path.name == "libLLVM-15.so.1"
    assert chosen.version == machine_library.version
    assert chosen.version[0] >= 17


def test_foreign_library_and_text_file_are_refused(tmp_path, foreign_library):
    with pytest.raises(SetupError, match="no libLLVM"):
        check_library(foreign_library)
    script = tmp_path / "libLLVM.so"
    script.write_text("INPUT(libLLVM.so.19.1)\n")
    with pytest.raises(SetupError, match="does not load"):
        check_library(script)


def test_missing_dependency_is_reported_by_name(tmp_path, foreign_library):
    overwrite_name(foreign_library, tmp_path / "libLLVM.so.19.1")
    with pytest.raises(SetupError, match=r"libLLVM\.so\.19\.1: it does not load: libQ\.so\.6"):
        find_llvm([tmp_path])


def test_users_unsuitable_choice_is_refused_and_not_replaced(monkeypatch, foreign_library):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(foreign_library))
    with pytest.raises(SetupError, match="DRJIT_LIBLLVM_PATH") as caught:
        find_llvm()
    assert str(foreign_library) in str(caught.value)
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(foreign_library)


def test_users_suitable_choice_is_used(monkeypatch, machine_library, tmp_path):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(machine_library.path))
    assert find_llvm([tmp_path]) == machine_library


def test_missing_runtime_library_of_drjit_is_reported(monkeypatch, machine_library):
    monkeypatch.setattr(llvm, "RUNTIME_LIBRARY", "libabsent.so.1")
    with pytest.raises(SetupError, match=r"Dr\.Jit needs libabsent\.so\.1.*\n(.*\n)*.*libatomic1"):
        find_llvm([machine_library.path.parent])


def test_command_line_shows_what_is_there_and_fails_without(capsys, monkeypatch, machine_library, foreign_library):
    assert main() == 0
    assert f"chosen: {machine_library}" in capsys.readouterr().out
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(foreign_library))
    assert main() == 2
    assert "DRJIT_LIBLLVM_PATH" in capsys.readouterr().err


def test_prepared_machine_runs_a_mitsuba_kernel(machine_library):
    script = (
        "import os, sys; before = set(sys.modules)\n"
        "import twin.backend.llvm\n"
        "assert not {'mitsuba', 'drjit', 'numpy'} & (set(sys.modules) - before)\n"
        "library = twin.backend.llvm.prepare_llvm()\n"
        "assert os.environ['DRJIT_LIBLLVM_PATH'] == str(library.path)\n"
        "import mitsuba as mi; mi.set_variant('llvm_ad_mono')\n"
        "import drjit as dr\n"
        "assert tuple(dr.detail.llvm_version()) == library.version\n"
        "assert twin.backend.llvm.prepare_llvm().version == library.version\n"
        "print(list(dr.arange(mi.Float, 3) + 1), library)"
    )
    child = run_child(script)
    assert child.stdout.strip() == f"[1.0, 2.0, 3.0] {machine_library}", child.stderr


def test_drjit_imported_too_early_without_llvm_is_reported(machine_library):
    script = (
        "import os\n"
        "import drjit\n"
        "os.environ.pop('DRJIT_LIBLLVM_PATH')\n"
        "from twin.backend.llvm import prepare_llvm; prepare_llvm()"
    )
    child = run_child(script, DRJIT_LIBLLVM_PATH="/no/such/libLLVM.so")
    assert child.returncode == 1
    assert "SetupError" in child.stderr and "no libLLVM" in child.stderr and "before the first import" in child.stderr
