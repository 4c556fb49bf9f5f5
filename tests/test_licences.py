"""Licences of the libraries that an installation of this project brings: none obliges a program that uses it.

Metadata of a library state its licence as an expression, as text or as classifiers. A library without any of them must
be listed here with what its files say: a new one fails until somebody has read them.
"""

import contextlib
import importlib
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
READ = {
    "docutils": "Public domain and BSD-2-Clause: its Emacs mode, the only other part, is not in the wheel",
    "hdf5plugin": "MIT for its own code; it names open licences for the compressors, which were not all read",
}
"""Licences read in a library's files, of libraries whose metadata state none or not those of the installed parts."""


def stated(library: metadata.Distribution) -> str:
    """Return the licence that metadata state; a whole text counts by its first line."""
    about = library.metadata
    classifiers = [line for line in about.get_all("Classifier") or [] if line.startswith("License ::")]
    # Not about["License"]: the package importlib_metadata, once imported, raises KeyError in place of None.
    expression, text = ("".join(about.get_all(name) or []).strip() for name in ("License-Expression", "License"))
    return READ.get(canonicalize_name(about["Name"])) or expression or "; ".join(classifiers + text.splitlines()[:1])


def obliges(licence: str) -> bool:
    """Return whether all alternatives of a licence are GPL or AGPL; Lesser GPL and exceptions for linking are not."""
    words = re.split(r"\bOR\b|; ", licence)
    strict = [
        re.search(r"\bA?GPL|(Affero|GNU) General Public", word) is not None
        and not re.search("Lesser|LGPL|exception", word)
        for word in words
    ]
    return bool(words) and (all(strict) if " OR " in licence else any(strict))


def closure(lines: list[str]) -> tuple[dict[str, metadata.Distribution], list[str]]:
    """Return the installed libraries that requirements bring along on this machine, and the absent ones' names."""
    waiting: list[tuple[str, set[str]]] = [(line, {""}) for line in lines]
    found, seen, absent = {}, set(), set()
    while waiting:
        line, extras = waiting.pop()
        one = Requirement(line)
        if one.marker is not None and not any(one.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        name = canonicalize_name(one.name)
        # Two libraries may need one with different extras.
        if (name, frozenset(one.extras)) in seen:
            continue
        seen.add((name, frozenset(one.extras)))
        try:
            found[name] = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            absent.add(name)
            continue
        waiting += [(inner, {"", *one.extras}) for inner in found[name].requires or ()]
    return found, sorted(absent)


def test_no_required_library_is_under_the_gpl():
    # Replaces the finder of the standard library in the whole process, as other tests do by what they import.
    with contextlib.suppress(ImportError):
        importlib.import_module("importlib_metadata")
    found, absent = closure(tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["dependencies"])
    assert not absent, f"required, but not installed: {', '.join(absent)}; install the project again (make setup)"
    licences = {name: stated(library) for name, library in found.items()}
    assert len(licences) > 25  # the libraries of pyproject.toml alone
    strict = {name: licence for name, licence in licences.items() if obliges(licence)}
    assert not strict, f"licences that oblige programs that use them: {strict}"
    silent = sorted(name for name, licence in licences.items() if not licence)
    assert not silent, f"no licence is stated by {', '.join(silent)}; read it in the files, and list it in READ"


def write_library(folder: Path, name: str, *lines: str) -> None:
    (folder / f"{name}-1.dist-info").mkdir()
    content = "\n".join(["Metadata-Version: 2.4", f"Name: {name}", "Version: 1", *lines])
    (folder / f"{name}-1.dist-info" / "METADATA").write_text(f"{content}\n", encoding="utf-8")


def test_extras_markers_and_absent_libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Only what is needed on this machine is looked for, and an absent library is named."""
    other_system = "Requires-Dist: no-such-licence-c; sys_platform == 'none'"
    write_library(tmp_path, "No_Such.Licence_A", "Requires-Dist: no-such-licence-b[more]", other_system)
    write_library(
        tmp_path,
        "no_such_licence_b",
        "License: MIT",
        "Requires-Dist: no_such_licence_d; extra == 'more'",
        "Requires-Dist: no_such_licence_e; extra == 'other'",
    )
    monkeypatch.syspath_prepend(tmp_path)
    found, absent = closure(["no-such-licence-b", "no-such-licence-a>=1"])
    assert found.keys() == {"no-such-licence-a", "no-such-licence-b"}
    assert absent == ["no-such-licence-d"]
    assert {name: stated(library) for name, library in found.items()} == {
        "no-such-licence-a": "",
        "no-such-licence-b": "MIT",
    }


@pytest.mark.parametrize(
    ("licence", "expected"),
    [
        ("GPL-3.0-or-later", True),
        ("License :: OSI Approved :: GNU General Public License v3 (GPLv3)", True),
        ("AGPL-3.0-only", True),
        ("MIT OR GPL-2.0-only", False),
        ("LGPL-3.0-or-later", False),
        ("License :: OSI Approved :: GNU Lesser General Public License v3 (LGPLv3)", False),
        ("GPL-2.0-or-later WITH Classpath-exception-2.0", False),
        ("BSD-3-Clause", False),
    ],
)
def test_which_licences_oblige(licence: str, expected: bool):
    assert obliges(licence) is expected
