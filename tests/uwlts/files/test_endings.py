"""The ending of an output decides its format, or is refused."""

import numpy as np
import pytest

import uwlts
from tests.uwlts.storage.drawn_captures import a_header
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import make_foreign_cloud


def _trajectory(path):
    uwlts.Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1))).save(path)


WRITERS = {
    "calibration": (lambda path: uwlts.nominal("thesis", medium="air").save(path), ".json"),
    "trajectory": (_trajectory, ".csv"),
    "capture": (lambda path: CaptureWriter(path, a_header(), dtype=np.uint8), ".h5"),
    "cloud": (lambda path: make_foreign_cloud(np.eye(3)).save(path), ".ply"),
}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("ending", [".laz.txt", ".png", ""])
def test_an_ending_of_another_format_is_refused(tmp_path, kind, ending):
    write, right = WRITERS[kind]
    with pytest.raises(uwlts.Error, match=f"ends with none of.*{right}"):
        write(tmp_path / f"q{ending}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("ending", "start"),
    [(".ply", b"ply"), (".LAZ", b"LASF"), (".las", b"LASF"), (".e57", b"ASTM-E57"), (".h5", b"\x89HDF")],
)
def test_the_ending_decides_the_format_of_a_cloud(tmp_path, ending, start):
    make_foreign_cloud(np.eye(3)).save(tmp_path / f"q{ending}")
    assert (tmp_path / f"q{ending}").read_bytes().startswith(start)
