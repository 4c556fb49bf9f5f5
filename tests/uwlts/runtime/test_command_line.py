"""Types of options by the types of parameters, and settings given as text."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from uwlts.errors import DescriptionError
from uwlts.runtime.command_line import PathText, option_type, parse_settings

Corner = tuple[float, float, float]


class Opened:
    """Something that cannot be given as text."""


@pytest.mark.parametrize(
    ("parameter", "option"),
    [
        (int, int),
        (str | Path | Opened, PathText),
        (str | Opened, str),
        (Path, Path),
        (Opened | str | Path | None, PathText | None),
        (Literal["a", "b"] | None, Literal["a", "b"] | None),
        (Sequence[Opened | str | Path], tuple[PathText, ...]),
        (str | Sequence[str], tuple[str, ...]),
        (str | Sequence[tuple[str, float]], str),
        (Literal["auto"] | tuple[Literal["k1", "k2"], ...], tuple[Literal["auto", "k1", "k2"], ...]),
        (tuple[Corner, Corner] | None, tuple[Corner, Corner] | None),
        (Sequence[Corner] | None, tuple[Corner, ...]),
        (Opened | Mapping[str, Any] | None, tuple[str, ...]),
        (np.ndarray | None, None),
        (Opened, None),
    ],
)
def test_options_have_the_types_that_text_can_give(parameter: Any, option: Any):
    assert option_type(parameter) == option


def test_settings_are_names_and_values():
    assert parse_settings("stripe", ["width=3", "peak=first", "on=true"]) == {"width": 3, "peak": "first", "on": True}
    for wrong in ("width", "=3", "width="):
        with pytest.raises(DescriptionError, match=f"`stripe` {wrong}: expected NAME=VALUE"):
            parse_settings("stripe", [wrong])
