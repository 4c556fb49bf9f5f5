"""The page of a scan."""

import sys
from pathlib import Path

import pytest

from uwlts.desk import scan
from uwlts.desk.scan import open_watch_page


def test_the_page_is_asked_for_at_the_port_that_is_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def started(command: list[str], **_: object) -> None:
        asked.append(command)
        raise KeyboardInterrupt

    monkeypatch.setattr(scan.subprocess, "Popen", started)
    page = open_watch_page(tmp_path / "a.h5", calibration=None, port=9123, say=print)
    with pytest.raises(KeyboardInterrupt), page as start:
        start()
    assert asked == [[sys.executable, "-m", "uwlts", "watch", str(tmp_path / "a.h5"), "--port", "9123"]]
