"""The ground-truth file: complete content, and refusal of inconsistent files."""

from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np
import pytest

from uwlts.errors import CaptureError, OutputError
from uwlts.model.library import load_sensor
from uwlts.storage.hdf5_file import write_label
from uwlts.storage.truth import Truth, TruthHeader, TruthStatus, read_truth, truth_path, write_truth

FRAMES, LINES = 3, 7
NAMES = [field.name for field in fields(Truth)]
LIGHT = ["centroid_px", "visible_fraction", "mixed_fraction"]


def a_truth() -> Truth:
    """Stripes on every other line."""
    rng = np.random.default_rng(3)
    hidden = np.arange(FRAMES * LINES).reshape(FRAMES, LINES) % 2 == 1
    normal = rng.normal(size=(FRAMES, LINES, 3))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    return Truth(
        centre_px=np.where(hidden, np.nan, rng.uniform(0, 100, (FRAMES, LINES))),
        point_mm=np.where(hidden[..., None], np.nan, rng.normal(size=(FRAMES, LINES, 3))),
        normal=np.where(hidden[..., None], np.nan, normal),
        status=np.where(hidden, TruthStatus.NO_STRIPE, TruthStatus.VISIBLE).astype(np.uint8),
        crossings=np.where(hidden, 0, 2).astype(np.uint8),
        depth_mm=np.full((16, 20), np.nan, np.float32),
        pose=np.tile(np.eye(4), (FRAMES, 1, 1)),
        **{name: np.where(hidden, np.nan, rng.uniform(0, 1, (FRAMES, LINES))) for name in LIGHT},
    )


def a_header() -> TruthHeader:
    sensor = load_sensor("thesis-as-built")
    scene = {"title": "Kügel", "objects": [{"kind": "sphere"}]}
    return TruthHeader(sensor=sensor, medium=sensor.media["water"], scene=scene)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_truth(tmp_path / "a.truth.h5", a_header(), a_truth())
    return tmp_path / "a.truth.h5"


def refused(path: Path, words: str) -> None:
    with pytest.raises(CaptureError, match=words) as caught:
        read_truth(path)
    assert str(path) in str(caught.value)


def test_everything_comes_back(path: Path):
    header, truth = read_truth(path)
    assert header == a_header()
    for name in NAMES:
        written, found = getattr(a_truth(), name), getattr(truth, name)
        assert found.dtype == written.dtype
        assert np.array_equal(found, written, equal_nan=found.dtype.kind == "f")


def test_scan_without_any_stripe(tmp_path: Path):
    nothing, nowhere = np.full((2, 4), np.nan), np.full((2, 4, 3), np.nan)
    hidden = np.full((2, 4), TruthStatus.NO_STRIPE, np.uint8)
    dark = Truth(nothing, nowhere, nowhere, hidden, np.zeros((2, 4), np.uint8), nothing)
    write_truth(tmp_path / "a.truth.h5", a_header(), dark)
    found = read_truth(tmp_path / "a.truth.h5")[1]
    assert (found.status == TruthStatus.NO_STRIPE).all()
    assert found.pose is None
    assert all(getattr(found, name) is None for name in LIGHT), "as in files of earlier versions"


def test_place_beside_the_capture():
    assert truth_path("runs/a.h5") == Path("runs/a.truth.h5")
    assert truth_path(Path("a.b.h5")) == Path("a.b.truth.h5")
    assert truth_path("a.hdf5") == Path("a.hdf5.truth.h5")


def test_nothing_in_the_file_can_run_or_point_elsewhere(path: Path):
    with h5py.File(path, "r") as file:
        kinds = [dataset.dtype.kind for dataset in file.values()]
        kinds += [file.attrs.get_id(name).dtype.kind for name in file.attrs]
        assert set(file) == set(NAMES)
    assert set(kinds) <= set("fuiS")


def test_existing_file_is_only_replaced_on_demand(path: Path):
    before = path.read_bytes()
    with pytest.raises(OutputError, match="exists already"):
        write_truth(path, a_header(), a_truth())
    assert path.read_bytes() == before
    write_truth(path, a_header(), a_truth(), overwrite=True)
    assert list(path.parent.iterdir()) == [path]


def test_files_that_are_no_truth(tmp_path: Path, path: Path):
    refused(tmp_path / "none.h5", "no truth file at")
    refused(tmp_path, "cannot read the truth file")
    other = tmp_path / "other.h5"
    for content in (b"", b"some text", path.read_bytes()[:4]):
        other.write_bytes(content)
        refused(other, "not a truth file, or is damaged")
    with h5py.File(other, "w") as file:
        file["status"] = np.zeros((2, 2))
    refused(other, "no format")
    with h5py.File(other, "w") as file:
        write_label(file, file_format="uwlts-capture", version=1, header=a_header())
    refused(other, "format is 'uwlts-capture', expected 'uwlts-truth'")


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.95])
def test_truncated_file(path: Path, share: float):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(path, "damaged")


def replaced(name: str, values: np.ndarray):
    def change(file: h5py.File) -> None:
        del file[name]
        file[name] = values

    return change


def changed_at(name: str, place: tuple, value: float):
    return lambda file: file[name].__setitem__(place, value)


CONTRADICTIONS = {
    "newer": (lambda file: file.attrs.__setitem__("version", 2), "version 2; .*reads up to 1"),
    "broken header": (lambda file: file.attrs.__setitem__("header", np.bytes_(b"{}")), "not a valid truth header"),
    "group": (lambda file: (file.__delitem__("status"), file.create_group("status")), "no numbers 'status'"),
    "text": (replaced("status", np.array([[b"ok"]])), "'status' are no numbers"),
    "one line": (replaced("centre_px", np.zeros(LINES)), "no numbers 'centre_px'"),
    "real status": (replaced("status", np.zeros((FRAMES, LINES))), "no numbers 'status'"),
    "fewer lines": (replaced("centre_px", np.zeros((FRAMES, LINES - 1))), "contradicts itself"),
    "fewer poses": (replaced("pose", np.zeros((FRAMES - 1, 4, 4))), "3 frames and poses"),
    "fewer centroids": (replaced("centroid_px", np.zeros((FRAMES, LINES - 1))), "contradicts itself"),
    "fewer frames": (replaced("normal", np.zeros((FRAMES - 1, LINES, 3))), "contradicts itself"),
    "plane points": (replaced("point_mm", np.zeros((FRAMES, LINES, 2))), "contradicts itself"),
    "unknown status": (changed_at("status", (0, 0), 9), "unknown statuses"),
    "no point": (changed_at("point_mm", (1, 1, 2), np.nan), "not finite"),
    "no normal": (changed_at("normal", (1, 1, 0), np.nan), "not finite"),
    "endless centre": (changed_at("centre_px", (1, 1), np.inf), "not finite"),
} | {
    f"missing {name}": (lambda file, name=name: file.__delitem__(name), f"no numbers '{name}'")
    for name in NAMES
    if name not in ("pose", *LIGHT)
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_contradictions(path: Path, case: str):
    change, words = CONTRADICTIONS[case]
    assert a_truth().status[1, 1] == TruthStatus.VISIBLE
    with h5py.File(path, "r+") as file:
        change(file)
    refused(path, words)
