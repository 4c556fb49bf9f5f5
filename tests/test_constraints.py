"""Checks the tested set of versions, `constraints.txt`, against what the project asks for."""

import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.oldest import PROJECT, requirements

TESTED = {
    canonicalize_name(one.name): one.specifier
    for line in PROJECT.with_name("constraints.txt").read_text(encoding="utf-8").splitlines()
    if not line.startswith("#")
    for one in [Requirement(line)]
}
NEEDED = list(requirements(tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"], ("test",)))


@pytest.mark.parametrize("needed", NEEDED, ids=lambda one: one.name)
def test_the_tested_set_holds_one_allowed_version_of_each_library(needed):
    (pinned,) = TESTED[canonicalize_name(needed.name)]
    assert pinned.operator == "=="
    assert pinned.version in needed.specifier
