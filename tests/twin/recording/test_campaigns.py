"""Plan of a folder of recordings: followed, rejected, or replaced."""

import json

import pytest

from twin.recording.campaigns import PLAN, keep_to_plan
from uwlts.errors import DescriptionError


def test_a_command_may_replace_the_plan_that_it_has_read(tmp_path):
    kinds = {"recorded": "*.h5", "called": "recordings"}
    (tmp_path / "a.h5").touch()
    (tmp_path / PLAN).write_text('{"seed": 1}', encoding="utf-8")
    with pytest.raises(DescriptionError, match="another seed"):
        keep_to_plan(tmp_path, {"seed": 2}, {tmp_path / "a.h5"}, overwrite=False, **kinds)
    keep_to_plan(tmp_path, {"seed": 2}, {tmp_path / "a.h5"}, overwrite=True, **kinds)
    assert json.loads((tmp_path / PLAN).read_text(encoding="utf-8")) == {"seed": 2}
    with pytest.raises(DescriptionError, match="would keep recordings"):
        keep_to_plan(tmp_path, {"seed": 3}, set(), overwrite=True, **kinds)
