"""Options of several commands of a program: the same name is the same kind of value with the same meaning."""

import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import pytest

import twin.cli
import uwlts.cli
from uwlts.runtime.command_line import PathText

APPS = {"uwlts": uwlts.cli.app, "twin": twin.cli.app}

MEANING = {
    "uwlts": {
        "--artefact": "artefact's kind and calibrated values|of known size",
        "--calibration": "[Cc]alibration",
        "--camera": "[Aa]ddress of (the|a) camera",
        "--captures": "[Cc]aptures",
        "--clock-drift-ppm": "Rate difference",
        "--clock-offset-s": "Offset from the times",
        "--cloud": "[Cc]loud",
        "--capture": "Capture|Scan",
        "--coloured": "write the (cloud coloured|points in the colours)",
        "--distortion": "Distortion coefficients to estimate",
        "--folder": "Folder",
        "--home": "Home the stage first",
        "--index": "[Rr]efractive index",
        "--kind": "Kind of the object",
        "--medium": "One of the sensor's media",
        "--mount": "Pose of the sensor on its platform",
        "--out": "to write|New folder",
        "--overwrite": "Replace|replace",
        "--pixels": "Whether pixels are square",
        "--page": "Page to write, with all figures",
        "--pdf": "Also print the page",
        "--plan": "[Pp]lan of a scan|TOML file with sensor, medium, positions",
        "--pose-format": "euler-ZYX-deg",
        "--pose-std-deg": "Standard uncertaint",
        "--pose-std-mm": "Standard uncertaint",
        "--pose-unit": "Unit of the .*positions",
        "--poses": "[Pp]ose",
        "--sensor": "sensor description",
        "--stage": "[Ss]erial port of (the|a) stage",
        "--step": "step standard",
        "--stripe": "stripe",
        "--stripe-method": "Method for the stripe's centre",
        "--stripe-peak": "Which of several stripes",
        "--trajectory": "times and poses of the platform",
        "--unlock": "Accept the stage's position",
        "--unit": "Unit of (clouds|a cloud) of (an)?other programs?",
        "--wall-mm": "wall",
        "--false-alarm": "Probability of any finding",
        "--largest-ovality": "ovality",
    },
    "twin": {
        "--as-built": "sensor to render",
        "--campaign": "campaign's description",
        "--campaigns": "Number of campaigns",
        "--first": "Seed of the first campaign",
        "--effects": "Effects of real images to add",
        "--every": "every",
        "--ideal": "pinhole",
        "--medium": "sensor's media",
        "--out": "Folder|Capture to write",
        "--overwrite": "again|Remove|Replace",
        "--placement": "Named position of the objects",
        "--scene": "scene",
        "--seed": "Seed of",
        "--sensor": "sensor description",
        "--spp": "[Ss]amples",
        "--variant": "variant",
        "--water": "Optical properties of the water",
        "--without": "Effects to (leave out|omit)",
        "--workers": "Number of",
    },
}
"""Words in every help of an option that several commands have."""


def options(program: str) -> dict[str, list[tuple[str, Any, str]]]:
    """Return command, type and help of each use of an option."""
    found = defaultdict(list)
    for command in APPS[program]:
        if not command.startswith("-"):
            for argument in APPS[program][command].assemble_argument_collection():
                found[argument.name].append((command, argument.hint, argument.parameter.help))
    return {name: uses for name, uses in found.items() if len(uses) > 1}


def kinds_of(hint: Any) -> Iterator[object]:
    """Return what a word of the option can be: a path or other text, a number, or certain words."""
    if get_origin(hint) in (Union, UnionType, tuple):
        for part in get_args(hint):
            if part not in (NoneType, ...):
                yield from kinds_of(part)
    elif get_origin(hint) is Literal:
        yield from get_args(hint)
    else:
        yield "text" if hint is str or issubclass(hint, PathText | Path) else hint


@pytest.mark.parametrize("program", APPS)
def test_the_same_option_has_one_kind_of_value(program: str):
    """Words of a choice may be fewer in one command than in another."""
    for name, uses in options(program).items():
        kinds = [set(kinds_of(hint)) for _, hint, _ in uses]
        largest = max(kinds, key=len)
        assert all(each <= largest for each in kinds), (name, [(command, hint) for command, hint, _ in uses])


@pytest.mark.parametrize("program", APPS)
def test_the_same_option_has_one_meaning(program: str):
    shared = options(program)
    assert len(shared) > 10
    for name, uses in shared.items():
        for command, _, text in uses:
            assert re.search(MEANING[program][name], text), (name, command, text)


@pytest.mark.parametrize("program", APPS)
def test_no_meaning_is_kept_without_its_option(program: str):
    assert MEANING[program].keys() - options(program).keys() == set()
