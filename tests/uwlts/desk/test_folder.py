"""The desk's folder: kinds of the listed files, and names outside the folder."""

import os
from pathlib import Path

import numpy as np
import pytest

from uwlts.desk.desk_files import find_file, guess_kind, list_files, new_path
from uwlts.errors import DescriptionError
from uwlts.optics.nominal import nominal
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import write_cloud


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "tank"
    place.mkdir()
    (tmp_path / "outside.h5").write_bytes(b"outside")
    (place / "scan.h5").write_bytes(b"capture")
    return place


@pytest.fixture
def unlisted(folder: Path) -> Path:
    """The folder with links that lead nowhere or out of it, and a pipe."""
    os.mkfifo(folder / "fifo.h5")
    (folder / ".hidden.h5").write_bytes(b"")
    (folder / "sub.h5").mkdir()
    (folder / "gone.h5").symlink_to(folder / "nothing")
    (folder / "loop.h5").symlink_to(folder / "loop.h5")
    (folder / "up.h5").symlink_to(folder.parent)
    (folder / "out.h5").symlink_to(folder.parent / "outside.h5")
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("scan.h5", "capture"),
        ("scan.of.today.h5", "capture"),
        ("scan.h5.part", "interrupted capture"),
        ("scan.truth.h5", "truth"),
        ("wall.ply", "cloud"),
        ("pipe.laz", "exported cloud"),
        ("calibration.json", "calibration"),
        ("plan.toml", "description"),
        ("wall.html", "report"),
        ("notes.txt", ""),
        ("scan.part", ""),
        ("h5", ""),
        ("", ""),
        ("scan.h5.bak", ""),
        ("scan.H5", ""),
    ],
)
def test_files_are_known_by_their_names(name, kind):
    assert guess_kind(name) == kind


def test_known_files_are_listed_the_latest_first(unlisted):
    folder = unlisted
    for age, name in enumerate(("wall.ply", "plan.toml", "calibration.json")):
        (folder / name).write_bytes(b"x" * age)
        os.utime(folder / name, (1e9 - age, 1e9 - age))
    os.utime(folder / "scan.h5", (2e9, 2e9))
    files = list_files(folder)
    assert [file.name for file in files] == ["scan.h5", "wall.ply", "plan.toml", "calibration.json"]
    assert [(file.kind, file.size, file.time_s) for file in files[:2]] == [("capture", 7, 2e9), ("cloud", 0, 1e9)]


def test_labels_describe_files_beyond_their_names(folder):
    none = np.full(2, -1)
    write_cloud(folder / "wall.h5", PointCloud(np.zeros((2, 3)), np.ones(2), none, none, metadata={}))
    nominal("thesis", medium="air").save(folder / "polished.json")
    for name, text in (
        ("damaged", "{"),
        ("other", '{"format": "mine"}'),
        ("figures", '{"format": "uwlts-evaluation"}'),
    ):
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    kinds = {file.name: file.kind for file in list_files(folder)}
    assert kinds.pop("scan.h5") in ("capture", "damaged file")
    assert kinds == {
        "wall.h5": "cloud",
        "polished.json": "calibration",
        "damaged.json": "damaged file",
        "figures.json": "evaluation",
    }
    # A rewritten file of the same name is a different file.
    (folder / "other.json").write_text('{"format": "uwlts-evaluation", "more": 1}', encoding="utf-8")
    os.utime(folder / "other.json", (1e9, 1e9))
    assert {file.name: file.kind for file in list_files(folder)}["other.json"] == "evaluation"


def test_a_long_list_is_cut(folder):
    for number in range(600):
        (folder / f"{number}.ply").touch()
        os.utime(folder / f"{number}.ply", (number, number))
    names = [file.name for file in list_files(folder)]
    assert len(names) == 500 and names[:2] == ["scan.h5", "599.ply"]


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DescriptionError, match="the folder .*nowhere cannot be read"):
        list_files(tmp_path / "nowhere")


def test_a_listed_file_is_found(folder):
    assert find_file(folder, "scan.h5") == folder / "scan.h5"


@pytest.mark.parametrize(
    "name",
    [
        "../outside.h5",
        "..",
        ".",
        "",
        "/",
        "./scan.h5",
        "scan.h5/",
        "tank/../scan.h5",
        "../tank/scan.h5",
        "{outside}",
        "//scan.h5",
        "none.h5",
        "notes.txt",
        ".hidden.h5",
        "..h5",
        "sub.h5",
        "up.h5",
        "out.h5",
        "within.h5",
        "fifo.h5",
        "gone.h5",
        "loop.h5",
        "scan.h5\0",
        "\0.h5",
        f"{'x' * 300}.h5",
        "scan.h5\n",
        "sc*n.h5",
        "\udcff.h5",
    ],
)
def test_names_that_lead_elsewhere_or_to_no_file_are_refused(unlisted, name):
    (unlisted / "..h5").write_bytes(b"")
    (unlisted / "within.h5").symlink_to(unlisted / "scan.h5")
    with pytest.raises(DescriptionError, match="is not a file of the folder"):
        find_file(unlisted, name.format(outside=unlisted.parent / "outside.h5"))


@pytest.mark.parametrize("name", ["wall", "wall.h5", " wall ", "wall-2_b", "größe", "wall.of.today"])
def test_a_result_gets_its_ending_once(folder, name):
    path = new_path(folder, name, suffix=".h5")
    assert path.parent == folder and path.suffix == ".h5" and not path.name.endswith(".h5.h5")
    assert path.name == path.name.strip()


@pytest.mark.parametrize(
    "name",
    ["", "  ", ".", "..", "/", "../wall", "a/b", "/tmp/wall", ".wall", " .wall", "wall/", "a\0b", "a\nb", "x" * 300],
)
def test_names_for_results_that_lead_elsewhere_are_refused(folder, name):
    with pytest.raises(DescriptionError, match="not a name for a file in the folder"):
        new_path(folder, name, suffix=".h5")
