"""Warnings and limits that a verification reports beside its verdicts."""

import numpy as np
import pytest

import uwlts
from uwlts.reconstruction.verify import find_undetectable_errors
from uwlts.report.file_description import evaluation_lines
from uwlts.storage.cloud import PointCloud


def test_a_reversed_stage_that_sizes_cannot_show_is_named():
    """A reversed stage that moves square to the sheet mirrors the cloud, which does not change lengths.

    At 30 deg from this direction, it shears the cloud by 2 tan 30 deg.
    """
    positions = np.arange(5.0)
    for direction in ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)):
        (said,) = find_undetectable_errors("spheres", positions, direction)
        assert "spheres" in said and "mirrors the cloud, such as a reversed stage" in said
    assert find_undetectable_errors("spheres", positions, (0.866, 0.0, 0.5)) == ()
    assert find_undetectable_errors("step", np.zeros(3), (1.0, 0.0, 0.0)) == (), "nothing moved"


@pytest.mark.parametrize(("share", "doubted"), [(0.0, False), (0.2, False), (0.5, True)])
def test_the_share_of_points_on_no_artefact_is_judged(share, doubted):
    rng = np.random.default_rng(4)
    away = rng.normal(size=(2, 3000, 3))
    away[..., 2] = -np.abs(away[..., 2])
    away *= 25 / np.linalg.norm(away, axis=2, keepdims=True)
    spheres = (away + np.array([[0, -50, 0], [0, 50, 0]])[:, None]).reshape(-1, 3)
    other = rng.uniform(-40, 40, (round(share / (1 - share) * len(spheres)), 3)) + [200, 0, 0]
    points = np.concatenate([spheres, other]) + rng.normal(0, 0.01, (len(spheres) + len(other), 3))
    cloud = PointCloud(points, *np.zeros((3, len(points))))
    artefact = {"kind": "spheres", "diameters_mm": [50.0, 50.0], "spacings_mm": [100.0]}
    found = uwlts.evaluate(cloud, artefact)
    # A few points of the spheres are outliers or mixed.
    assert found.evaluation.strange_share == pytest.approx(share, abs=0.01)
    assert bool(found.evaluation.doubts()) is doubted
    assert f"({100 * found.evaluation.strange_share:.1f} %) on no artefact" in "".join(evaluation_lines(found))
