"""The truth of another capture is refused, by its scene, its images, or its name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from uwlts.errors import EvaluationError
from uwlts.evaluation.evaluate import Evaluation, evaluate
from uwlts.evaluation.figures import TruthComparison
from uwlts.model.library import load_sensor
from uwlts.storage.cloud import PointCloud
from uwlts.storage.truth import Truth, TruthHeader, scene_digest, write_truth

FRAMES, LINES = 6, 30
SCENE = {"name": "spheres", "medium": "water", "artefact": {"kind": "spheres"}, "objects": [{"z_mm": 300.0}]}
METADATA = {"capture": "a.h5", "medium": "water", "images": FRAMES, "scene": scene_digest(SCENE)}
OLD = {key: value for key, value in METADATA.items() if key not in ("scene", "images")}


def a_plane(frames: int = FRAMES) -> np.ndarray:
    """Return points (F, L, 3) of a plane."""
    frame, line = np.mgrid[:frames, :LINES].astype(float)
    return np.stack([frame, line, np.full_like(frame, 300.0)], axis=2)


def truth_file(path: Path, *, scene: dict, step: int = 1) -> Path:
    points = a_plane()[::step]
    lines = points.shape[:2]
    truth = Truth(
        centre_px=np.zeros(lines),
        point_mm=points,
        normal=np.tile((0.0, 0.0, -1.0), (*lines, 1)),
        status=np.zeros(lines, np.uint8),
        crossings=np.ones(lines, np.uint8),
        depth_mm=np.zeros((4, 4), np.float32),
    )
    sensor = load_sensor("thesis")
    write_truth(path, TruthHeader(sensor=sensor, medium=sensor.media["water"], scene=scene), truth)
    return path


def a_cloud(metadata: dict, *, frames: int = FRAMES) -> PointCloud:
    frame, line = (each.ravel() for each in np.mgrid[:frames, :LINES])
    points = a_plane(frames).reshape(-1, 3) - (0.0, 0.0, 0.25)
    return PointCloud(points, np.ones(len(points), np.float32), frame, line, metadata=metadata)


@pytest.mark.parametrize("metadata", [METADATA, OLD, {}], ids=["this-version", "earlier", "foreign"])
def test_the_truth_of_the_capture_is_accepted(tmp_path: Path, metadata: dict):
    found = evaluate(a_cloud(metadata), truth=truth_file(tmp_path / "a.truth.h5", scene=SCENE)).truth
    assert found is not None and found.mean_mm == pytest.approx(0.25)


def test_the_file_of_a_known_scene_may_be_renamed(tmp_path: Path):
    path = truth_file(tmp_path / "b.truth.h5", scene=SCENE)
    assert evaluate(a_cloud(METADATA), truth=path).truth is not None


@pytest.mark.parametrize(
    ("metadata", "scene", "name", "words"),
    [
        (METADATA, SCENE | {"objects": [{"z_mm": 302.2}]}, "a", "its scene has the digest"),
        (
            OLD | {"artefact": {"kind": "step", "height_mm": 20.0}},
            SCENE,
            "a",
            "it shows the artefact 'spheres', the cloud 'step'",
        ),
        (OLD | {"medium": "air"}, SCENE, "a", "its medium is water, that of the cloud air"),
        (OLD, SCENE, "b", "the cloud is of a.h5, which does not state its scene, and whose truth is named a.truth.h5"),
    ],
)
def test_the_truth_of_another_scan_is_refused(tmp_path: Path, metadata: dict, scene: dict, name: str, words: str):
    path = truth_file(tmp_path / f"{name}.truth.h5", scene=scene)
    with pytest.raises(EvaluationError, match=f"truth of another capture: {words}"):
        evaluate(a_cloud(metadata), truth=path)


def test_the_truth_of_every_second_image_is_refused(tmp_path: Path):
    half = truth_file(tmp_path / "a.truth.h5", scene=SCENE, step=2)
    # All frames of the points exist in the truth.
    first = a_cloud(METADATA, frames=FRAMES // 2)
    with pytest.raises(EvaluationError, match="of a capture of 6 images, the truth of one of 3"):
        evaluate(first, truth=half)
    whole = truth_file(tmp_path / "b.truth.h5", scene=SCENE)
    with pytest.raises(EvaluationError, match="of a capture of 3 images, the truth of one of 6"):
        evaluate(replace(first, metadata=METADATA | {"images": 3}), truth=whole)


@pytest.mark.parametrize("index", [float("inf"), float("nan")])
def test_a_stored_evaluation_has_finite_values(index: float) -> None:
    Evaluation(cloud="a.ply", medium_index=1.33)
    with pytest.raises(ValidationError, match="finite number"):
        Evaluation(cloud="a.ply", medium_index=index)


@pytest.mark.parametrize(
    ("name", "value"), [("share_within_tolerance", -0.01), ("share_within_tolerance", 1.01), ("missed", -1)]
)
def test_stored_fractions_and_counts_are_possible(tmp_path: Path, name: str, value: float) -> None:
    found = evaluate(a_cloud(METADATA), truth=truth_file(tmp_path / "a.truth.h5", scene=SCENE)).truth
    assert found is not None
    assert TruthComparison.model_validate(found.model_dump()) == found
    with pytest.raises(ValidationError, match=name):
        TruthComparison.model_validate(found.model_dump() | {name: value})
