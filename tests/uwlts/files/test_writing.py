"""Removal of incomplete files at an interrupt at any point, and folders that take no file."""

import os
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from uwlts.errors import OutputError
from uwlts.files import writing
from uwlts.files.writing import refuse_unsuitable, write_atomically


def interrupted_at(step: int, target: Path) -> bool:
    """Write a file with an interrupt before instruction number ``step`` of the module; False if there are fewer."""
    left = step

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal left
        if frame.f_code.co_filename != writing.__file__:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            left -= 1
            if left == 0:
                sys.settrace(None)
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        with write_atomically(target, overwrite=True) as aside:
            aside.write_text("complete", encoding="utf-8")
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def test_an_interrupt_at_any_moment_leaves_a_complete_file_or_none(tmp_path):
    steps = whole = 0
    while interrupted_at(steps + 1, target := tmp_path / f"{steps}.txt"):
        steps += 1
        assert [path for path in tmp_path.iterdir() if path.name.startswith(".")] == [], steps
        if target.exists():
            whole += 1
            assert target.read_text(encoding="utf-8") == "complete"
    assert steps > 100
    assert 0 < whole < steps / 2


def test_a_folder_that_takes_no_file_is_refused_before_the_work(tmp_path, monkeypatch):
    """A read-only file system; an administrator may write to any other folder."""
    monkeypatch.setattr(os, "access", lambda path, mode: not (Path(path) == tmp_path and mode == os.W_OK))
    with pytest.raises(OutputError, match=f"cannot write .*out.json: {tmp_path} is read-only, or permission"):
        refuse_unsuitable(tmp_path / "out.json", overwrite=True)


def test_a_failed_removal_of_the_incomplete_file_does_not_replace_the_first_error(tmp_path, monkeypatch):
    def refuse(self: Path, *, missing_ok: bool = False) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OutputError, match="the first"), write_atomically(tmp_path / "out.json"):
        raise OutputError("the first")
