"""Names and texts from files cannot control the terminal."""

import re

import numpy as np
import pytest

from uwlts.cli import app
from uwlts.errors import CaptureError, make_printable
from uwlts.storage.cloud import make_foreign_cloud
from uwlts.storage.cloud_files import read_cloud, write_cloud

EVIL = "a\x1b[31mred\x1b]0;title\x07\r\x9b2Jb\u202egnp.exe\udcff"
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e\udc80-\udcff]")


def test_control_characters_become_escapes_and_others_stay():
    assert make_printable(EVIL) == r"a\x1b[31mred\x1b]0;title\x07\r\x9b2Jb\u202egnp.exe\udcff"
    plain = "tank 3: 20 °C, Grüße, 水槽, ± 0.1 µm\t≤\n\U0001f916"
    assert make_printable(plain) == plain


def test_messages_and_warnings_about_files_are_printable(tmp_path, caplog):
    path = tmp_path / f"{EVIL.replace('/', '')}.ply"
    with pytest.raises(CaptureError) as caught:
        read_cloud(path)
    assert not CONTROL.search(str(caught.value)) and r"\x1b[31m" in str(caught.value)
    text = tmp_path / "evil\x1b[31m.txt"
    text.write_text("x,y,z\n1,2,3\n1,2,nan\n")
    read_cloud(text)
    assert "1 of 2 points" in caplog.text and not CONTROL.search(caplog.text)


def test_texts_in_a_file_are_printed_as_escapes(tmp_path, capsys):
    cloud = make_foreign_cloud(np.eye(3))
    cloud.metadata["sensor"] = EVIL[:-1]
    write_cloud(tmp_path / "a.ply", cloud)
    app(["info", str(tmp_path / "a.ply")], result_action="return_value")
    printed = capsys.readouterr().out
    assert not CONTROL.search(printed) and r"sensor: a\x1b[31mred" in printed
