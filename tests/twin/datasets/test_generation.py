"""Data sets as files: the same for any number of workers, resumed, refused, described by their card, and read again."""

import gc
import json
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import webdataset

import twin
from tests.virtual_sensors import altered
from twin.datasets.data_set import DataSetDescription, LineStatus, load_description
from twin.datasets.generation import draw_scene
from uwlts.errors import ArgumentError, CaptureError, DescriptionError, DesignError, OutputError
from uwlts.files.json_files import json_text
from uwlts.files.writing import hash_file
from uwlts.model.library import load_sensor
from uwlts.radiometry.stripe_windows import open_image_set
from uwlts.storage.data_set import Split

SMALL = {"camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4}}
LABELS = ("centre", "quality", "points", "masks", "light", "depth", "sensor")


def small(**changes: object) -> DataSetDescription:
    """Eight scenes of two frames each, in tiny images."""
    table = {
        "title": "small",
        "licence": "CC0-1.0",
        "sensor": altered(load_sensor("thesis"), SMALL | {"exposure": {"laser_ms": 2.0}}),
        "scene": "spheres",
        "motion": {"start_mm": -4.0, "step_mm": 8.0, "count": 2},
        "scenes": 8,
        "scenes_per_shard": 2,
        "splits": {"train": 0.5, "validation": 0.25, "test": 0.25},
        "spp": 4,
        "without": ("multiple-scattering", "secondary-light"),
        "labels": LABELS,
        "vary": {
            "sensor.laser.power_mw": {"kind": "uniform", "least": 5.0, "most": 9.0},
            "scene.placements.standoff.position_mm.2": {"kind": "uniform", "least": 0.0, "most": 30.0},
            "scene.water": {"kind": "choice", "values": ("clear", "coastal")},
        },
    }
    return DataSetDescription.model_validate(table | changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small data set, made by one process."""
    return twin.dataset(small(), out=tmp_path_factory.mktemp("sets") / "small", workers=1)


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: hash_file(path) for path in sorted(folder.glob("*.tar"))}


def test_another_seed_makes_other_files(folder, tmp_path):
    made = hashes(folder)
    assert len(made) >= 4
    other = hashes(twin.dataset(small(scenes=2), out=tmp_path / "seed", seed=1, workers=1))
    assert not set(other.values()) & set(made.values())


def test_frames_are_those_of_the_twin(folder):
    sample = twin.load_dataset(folder)[5]
    info = sample["info"]
    drawn = draw_scene(small(), info["scene"])
    again = twin.render(
        drawn.scene,
        sensor=drawn.sensor,
        spp=4,
        seed=info["seed"],
        without=("multiple-scattering", "secondary-light"),
        frames=[info["frame"]],
    )
    np.testing.assert_array_equal(sample["image"], again.images[0])
    np.testing.assert_array_equal(sample["centre_px"], again.truth.centre_px[0].astype(np.float32))
    assert info["exposure_ms"] == again.exposure_ms[0] == 2.0
    assert info["as_built"]["laser"]["power_mw"] == info["drawn"]["sensor.laser.power_mw"]
    assert info["medium"]["water"] == info["drawn"]["scene.water"]
    # The pose maps from the sensor to the scene, as everywhere.
    assert info["T_scene_object"][0][3] == info["stage_mm"] == (-4.0, 4.0)[info["frame"]]


def test_an_interrupted_run_goes_on(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    made, lost = hashes(copy), sorted(copy.glob("*.tar"))[1]
    lost.unlink()
    (copy / "dataset.json").unlink()
    (copy / "mine.txt").write_text("kept", encoding="utf-8")
    kept = {path: path.stat().st_mtime_ns for path in copy.glob("[a-z]*.tar")}
    with pytest.raises(CaptureError, match="run twin dataset again"):
        twin.load_dataset(copy)
    twin.dataset(small(), out=copy, workers=1)
    assert hashes(copy) == made
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert not list(copy.glob(".*")) and (copy / "mine.txt").is_file()


def test_another_data_set_is_refused_unless_it_is_to_be_replaced(folder, tmp_path, caplog):
    place = twin.dataset(
        small(scenes=2, splits={"train": 1, "validation": 0, "test": 0}), out=tmp_path / "x", workers=1
    )
    with pytest.raises(DescriptionError, match=r"holds a data set made with another .*scenes is 2 in it, 1 now"):
        twin.dataset(small(scenes=1), out=place, workers=1)
    (place / "mine.txt").write_text("kept", encoding="utf-8")
    only = {"splits": {"train": 0, "validation": 0, "test": 1}, "labels": ("centre",), "scenes": 1}
    assert "at the maximum" not in caplog.text
    day = {"exposure": {"laser_ms": 5000.0}, "lamp": {"ambient_w_per_m2": 1.0}}
    only["sensor"] = altered(load_sensor("thesis"), SMALL | day)
    twin.dataset(small(**only), out=place, workers=1, overwrite=True)
    assert "2 of 2 images have more than 3 % of their pixels at the maximum" in caplog.text
    assert [path.name for path in place.glob("*.tar")] == ["test-000000.tar"]
    assert (place / "mine.txt").is_file()
    with pytest.raises(DescriptionError, match="workers is 0"):
        twin.dataset(small(), out=place, workers=0)
    with pytest.raises(OutputError, match="cannot use the folder"):
        twin.dataset(small(), out=place / "mine.txt", workers=1)


def test_long_exposures_in_daylight_leave_images_that_show_the_stripe(tmp_path):
    day = {"lamp": {"ambient_w_per_m2": 30.0}, "exposure": {"laser_ms": "auto"}}
    changes = {"sensor": altered(load_sensor("thesis"), SMALL | day), "scenes": 2, "labels": ("centre",)}
    long = {"frame.exposure": {"kind": "choice", "values": [50.0]}}
    shown = twin.load_dataset(twin.dataset(small(**changes, vary=long), out=tmp_path / "day", workers=1))
    for sample in shown:
        # 3 % may be above 0.8 of full scale; without the limit, the sphere and the stripe would be white.
        assert np.quantile(sample["image"], 0.98) > 0.8 * 255 and (sample["image"] > 0.85 * 255).mean() < 0.05
        assert (sample["status"] != LineStatus.NOT_CROSSED).sum() > 10 and sample["info"]["exposure_ms"] > 0


def test_scenes_that_the_sensor_cannot_see_are_drawn_anew(tmp_path, monkeypatch):
    # The measuring volume ends some 110 mm about the stand-off along the camera's axis.
    far = {"scene.placements.standoff.position_mm.2": {"kind": "uniform", "least": 0.0, "most": 400.0}}
    described = small(scenes=3, labels=("centre",), splits={"train": 1, "validation": 0, "test": 0}, vary=far)
    card = twin.load_dataset(twin.dataset(described, out=tmp_path / "far", workers=1)).card
    assert card.redrawn > 0
    least = {"scene.placements.standoff.position_mm.2": {"kind": "uniform", "least": 300.0, "most": 400.0}}
    monkeypatch.setattr("twin.datasets.generation.MOST_ATTEMPTS", 3)
    with pytest.raises(DesignError, match="was drawn 3 times"):
        twin.dataset(small(vary=least), out=tmp_path / "farther", workers=1)


def test_scenes_with_too_little_of_the_stripe_are_drawn_anew(tmp_path, monkeypatch):
    one = {"scenes": 6, "labels": ("centre",), "splits": {"train": 1, "validation": 0, "test": 0}}
    weak = {"sensor.laser.power_mw": {"kind": "choice", "values": (1e-4, 7.0)}}
    sets = [
        twin.load_dataset(
            twin.dataset(small(**one, vary=weak, least_stripe=least), out=tmp_path / f"{least}", workers=1)
        )
        for least in (0.0, 0.2)
    ]
    shown = LineStatus.VISIBLE, LineStatus.SATURATED
    seen = [[np.isin(sample["status"], shown).mean() for sample in each] for each in sets]
    assert min(seen[0]) == 0 and min(seen[1]) >= 0.2
    assert sets[0].card.redrawn == 0 < sets[1].card.redrawn < 6
    monkeypatch.setattr("twin.datasets.generation.MOST_ATTEMPTS", 2)
    with pytest.raises(DesignError, match="image 0 has the stripe on .*% of its lines, less than least_stripe"):
        twin.dataset(small(**one, least_stripe=1.0), out=tmp_path / "all", workers=1)
    with pytest.raises(ValueError, match="least_stripe 0.2 needs the label 'centre'"):
        small(labels=("masks",), least_stripe=0.2)


def test_splits_hold_different_scenes_and_together_all(folder):
    scenes = {
        split: {each["info"]["scene"] for each in twin.load_dataset(folder, split=split)} for split in get_args(Split)
    }
    assert sorted(scene for members in scenes.values() for scene in members) == list(range(8))
    assert all(members for members in scenes.values())
    for split in get_args(Split):
        assert {each["info"]["split"] for each in twin.load_dataset(folder, split=split)} == {split}


def test_samples_are_read_in_any_way(folder):
    everything = twin.load_dataset(folder)
    assert len(everything) == 16 == len(list(everything))
    assert "torch" not in sys.modules
    keys = [sample["key"] for sample in everything]
    assert len(set(keys)) == 16
    assert everything[-1]["key"] == keys[-1] and [each["key"] for each in everything[3:5]] == keys[3:5]
    with pytest.raises(IndexError):
        everything[16]
    again = pickle.loads(pickle.dumps(everything))
    np.testing.assert_array_equal(again[7]["image"], everything[7]["image"])
    sample = everything[0]
    shapes = {name: values.shape for name, values in sample.items() if isinstance(values, np.ndarray)}
    assert set(shapes) == {"image"} | set(everything.card.labels)
    assert shapes["image"] == shapes["mask"] == shapes["depth_mm"] == shapes["object_map"] == (128, 160)
    assert shapes["centre_px"] == shapes["snr"] == (160,) and shapes["point_mm"] == (160, 3)
    assert shapes["light_e"] == (5, 128, 160)
    few = twin.load_dataset(folder, names=["image", "centre_px"])[0]
    assert set(few) == {"key", "image", "centre_px"}
    with pytest.raises(ArgumentError, match="`split` is 'dev' .*, expected 'train', 'validation' or 'test'"):
        twin.load_dataset(folder, split="dev")
    with pytest.raises(DescriptionError, match="unknown centres; the data set contains bound_px"):
        twin.load_dataset(folder, names=["centres"])


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_webdataset_library_reads_the_shards(folder):
    shards = [str(path) for path in sorted(folder.glob("train-*.tar"))]
    read = list(webdataset.WebDataset(shards, shardshuffle=False).decode("l8"))
    gc.collect()  # the library leaves files open
    own = twin.load_dataset(folder, split="train")
    assert [each["__key__"] for each in read] == [each["key"] for each in own]
    for theirs, ours in zip(read, own, strict=True):
        np.testing.assert_array_equal(theirs["centre_px.npy"], ours["centre_px"])
        np.testing.assert_array_equal(theirs["light_e.npy"], ours["light_e"])
        assert theirs["json"] == ours["info"]
        np.testing.assert_array_equal(theirs["png"], ours["image"])
        np.testing.assert_array_equal(theirs["mask.png"], ours["mask"])


def test_statistics_of_stripes_read_a_data_set(folder):
    found, card = open_image_set(folder), twin.load_dataset(folder).card
    assert (found.count, found.stripe_along, found.full_dn) == (16, "width", 2 ** card.image["bits"] - 1)
    expected = [sample["image"] for sample in twin.load_dataset(folder)]
    np.testing.assert_array_equal(list(found.images(100)), expected)
    np.testing.assert_array_equal(list(found.images(2)), [expected[0], expected[15]])


def test_the_card_says_what_there_is(folder):
    card = twin.load_dataset(folder).card
    assert sum(card.frames.values()) == 16 and sum(card.scenes.values()) == 8
    assert sum(card.status.values()) == 16 * 160
    power = [each["info"]["drawn"]["sensor.laser.power_mw"] for each in twin.load_dataset(folder)]
    assert card.drawn["sensor.laser.power_mw"]["least"] == min(power)
    assert card.drawn["scene.water"] == {"clear": pytest.approx(4, abs=4), "coastal": pytest.approx(4, abs=4)}
    assert {shard.name: shard.sha256 for shard in card.shards} == hashes(folder)
    json.loads((folder / "plan.json").read_text(encoding="utf-8"))


def test_damaged_files_are_named(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    shard = copy / twin.load_dataset(copy).card.shards[0].name
    shard.write_bytes(shard.read_bytes()[:5000])
    with pytest.raises(CaptureError, match=re.escape(f"{shard} is not a shard")):
        twin.load_dataset(copy)[0]
    shard.unlink()
    with pytest.raises(CaptureError, match=re.escape(shard.name)):
        twin.load_dataset(copy)[0]
    card = copy / "dataset.json"
    text = card.read_text(encoding="utf-8").replace(f'"{shard.name}"', '"../other.tar"')
    card.write_text(json_text(json.loads(text)), encoding="utf-8")
    with pytest.raises(CaptureError, match="which is not a file of a data set"):
        twin.load_dataset(copy)
    with pytest.raises(CaptureError, match="run twin dataset again"):
        twin.load_dataset(tmp_path)


@pytest.mark.slow
def test_ctrl_c_leaves_complete_shards_only(tmp_path):
    out = tmp_path / "set"
    line = [sys.executable, "-m", "twin", "dataset", "stripe-clean", "--scenes", "40", "--out", str(out)]
    process = subprocess.Popen([*line, "--workers", "2"], stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 120
    while not list(out.glob(".*.tar")) and time.monotonic() < until:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130, told
    assert "run it again" in told and "Traceback" not in told
    assert [path.name for path in out.iterdir() if path.suffix != ".tar"] == ["plan.json"]
    assert not list(out.glob(".*"))


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path):
    half = 'base = "thesis"\nname = "half"\n[camera]\nwidth_px = 320\nheight_px = 256\npixel_size_um = 21.2\n'
    (tmp_path / "half.toml").write_text(half, encoding="utf-8")
    text = 'title = "many"\nsensor = "half.toml"\nscene = "spheres"\nlabels = ["masks", "light"]\n'
    text += 'without = ["multiple-scattering", "secondary-light"]\nspp = 4\n[motion]\ncount = 4\n'
    (tmp_path / "many.toml").write_text(text, encoding="utf-8")
    program = (
        "import resource, sys, twin\n"
        "twin.dataset(sys.argv[1], out=sys.argv[2], scenes=int(sys.argv[3]), workers=1)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    used_mb = []
    for scenes in (2, 12):
        line = [sys.executable, "-c", program, str(tmp_path / "many.toml"), str(tmp_path / f"of {scenes}"), str(scenes)]
        used_mb.append(int(subprocess.run(line, check=True, capture_output=True, text=True).stdout) / 1024)
    # The light of a frame, five numbers of 4 bytes for each pixel, is 1.6 MB, and half of it as a label: 40 more frames
    # would need 100 MB.
    assert used_mb[1] - used_mb[0] < 50


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["stripe-turbid", "stripe-shiny", "stripe-tank", "pipe-inspection", "calibration-boards"]
)
def test_presets_are_rendered(name, tmp_path):
    coarse = {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}}
    table = load_description(name).model_dump(exclude_unset=True) | {"sensor": altered(load_sensor("thesis"), coarse)}
    # Two of its frames show all lights and labels.
    motion = table["motion"] | {"count": min(table["motion"]["count"], 2)}
    described = DataSetDescription.model_validate(table | {"motion": motion, "spp": 4})
    samples = twin.load_dataset(twin.dataset(described, out=tmp_path / name, scenes=1, workers=1))
    for sample in samples:
        assert sample["image"].max() > 10 or sample["info"]["exposure_ms"] > 0
        if sample["info"]["light"] == "laser":
            assert np.isfinite(sample["centre_px"]).sum() > 100
    if name == "calibration-boards":
        assert np.isfinite(samples[0]["target_px"]).all(axis=1).sum() > 50


@pytest.mark.slow
def test_runs_that_share_a_folder_make_the_same_files(folder, tmp_path):
    """Files are the same for any number of workers, also of two runs at once."""
    with ThreadPoolExecutor(2) as runs:
        made = [runs.submit(twin.dataset, small(), out=tmp_path / "shared", workers=2) for _ in range(2)]
    assert {each.result() for each in made} == {tmp_path / "shared"}
    assert hashes(tmp_path / "shared") == hashes(folder)
    assert not list((tmp_path / "shared").glob(".*"))
