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
    return READ.get(about["Name"]) or expression or "; ".join(classifiers + text.splitlines()[:1])


def obliges(licence: str) -> bool:
    """Return whether all alternatives of a licence are GPL or AGPL; Lesser GPL and exceptions for linking are not."""
    words = re.split(r"\bOR\b|; ", licence)
    strict = [
        re.search(r"\bA?GPL|(Affero|GNU) General Public", word) is not None
        and not re.search("Lesser|LGPL|exception", word)
        for word in words
    ]
    return bool(words) and (all(strict) if " OR " in licence else any(strict))


def closure() -> dict[str, metadata.Distribution]:
    waiting, found = list(tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["dependencies"]), {}
    while waiting:
        one = Requirement(waiting.pop())
        name = canonicalize_name(one.name)
        extras = one.extras or {""}
        if one.marker is not None and not any(one.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        if name not in found:
            found[name] = metadata.distribution(name)
            for line in found[name].requires or ():
                inner = Requirement(line)
                if inner.marker is None or any(inner.marker.evaluate({"extra": extra}) for extra in extras):
                    inner.marker = None
                    waiting.append(str(inner))
    return found


def test_no_required_library_is_under_the_gpl():
    # Replaces the finder of the standard library in the whole process, as other tests do by what they import.
    with contextlib.suppress(ImportError):
        importlib.import_module("importlib_metadata")
    licences = {name: stated(library) for name, library in closure().items()}
    assert len(licences) > 25  # the libraries of pyproject.toml alone
    assert {name: licence for name, licence in licences.items() if obliges(licence)} == {}
    assert [name for name, licence in licences.items() if not licence] == []


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
