"""Removal of incomplete files at an interrupt at any point."""

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from uwlts.errors import OutputError
from uwlts.files import writing
from uwlts.files.writing import lock_output, remove_unfinished, write_atomically


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
        remove_unfinished()
        assert [path for path in tmp_path.iterdir() if path.name.startswith(".")] == [], steps
        if target.exists():
            whole += 1
            assert target.read_text(encoding="utf-8") == "complete"
    assert steps > 300
    assert 0 < whole < steps / 2


def test_locks_of_others_stay(tmp_path):
    import subprocess

    target = tmp_path / "a.txt"
    program = (
        "import sys, pathlib\nfrom uwlts.files.writing import lock_output\n"
        "with lock_output(pathlib.Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.read()\n"
    )
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", program, str(target)], **pipes) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match="is writing it"), lock_output(target):
            pass
        remove_unfinished()
        assert (tmp_path / ".a-txt.lock").exists()
        holder.communicate()
    assert list(tmp_path.iterdir()) == []
