"""Long scans with poses: found and written part by part, with the points and the uncertainty of the whole scan."""

import numpy as np
import pytest

import uwlts
from tests.bench.streams import write_ride
from uwlts.reconstruction import reconstruct as module
from uwlts.storage.cloud import concatenate_clouds
from uwlts.storage.cloud_files import write_cloud_in_parts

FRAMES = 40


@pytest.fixture(scope="module")
def ride(tmp_path_factory):
    """Return a function that reconstructs a ride with further arguments, and its folder."""
    folder = tmp_path_factory.mktemp("ride")
    write_ride(folder, FRAMES)
    trajectory = folder / "path.csv"

    def reconstruct(**more):
        return uwlts.reconstruct(
            folder / "ride.h5",
            folder / "calibration.json",
            mount=folder / "mount.json",
            trajectory=trajectory,
            pose_format="quaternion-xyzw",
            **more,
        )

    return reconstruct, folder


@pytest.fixture(scope="module")
def both(ride):
    """Return the whole cloud, its parts, and what is returned with the parts."""
    reconstruct, _ = ride
    whole, parts = reconstruct(), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_PART", 4000)
        patch.setattr(module, "_KEPT_IMAGES", 10)
        result = reconstruct(take=parts.append)
    return whole, parts, result


def test_points_are_those_of_the_whole_scan(both):
    whole, parts, _ = both
    assert len(parts) >= 4 and all(4000 <= len(part) <= 12000 for part in parts)
    together = concatenate_clouds(parts)
    np.testing.assert_array_equal(together.frame, whole.frame)
    np.testing.assert_array_equal(together.line, whole.line)
    np.testing.assert_allclose(together.points_mm, whole.points_mm, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(together.time_s, whole.time_s)


def test_parts_share_their_errors(both):
    """Differences between points of different parts have the covariance of the whole scan, but for noise."""
    whole, parts, _ = both
    together = concatenate_clouds(parts)
    assert {frozenset(part.uncertainty.shared) for part in parts} == {frozenset(whole.uncertainty.shared)}
    some = np.linspace(0, len(whole) - 1, 60).astype(int)
    shifts = [
        known.patterns_mm[:, some].astype(float).reshape(-1, 180) for known in (whole.uncertainty, together.uncertainty)
    ]
    expected, found = (each.T @ each for each in shifts)
    # Omitted patterns move points by 5e-5 mm, and the path's by 0.1 % of its variance.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * expected.max())
    # The factor for correlated noise of each part is from 4,000 centres: its standard error is 4 %.
    ratio = together.uncertainty.random_mm2[:, 5] / whole.uncertainty.random_mm2[:, 5]
    assert ratio.min() > 0.8 and ratio.max() < 1.25


def test_the_result_is_a_sample_with_the_counts_of_all(both):
    whole, _, result = both
    assert result.lines_by_status == whole.lines_by_status
    assert result.rays_by_status == whole.rays_by_status
    assert result.rays_by_status["ok"] == len(whole)
    assert set(result.frame.tolist()) == set(range(0, FRAMES, 4)) and not (result.line % 4).any()


def test_files_hold_all_parts(both, tmp_path):
    _, parts, _ = both
    together = concatenate_clouds(parts)
    for name in ("parts.h5", "parts.full.ply"):
        with write_cloud_in_parts(tmp_path / name) as write:
            for part in parts:
                write(part)
        found = uwlts.read(tmp_path / name)
        np.testing.assert_array_equal(found.points_mm, together.points_mm)
        np.testing.assert_array_equal(found.uncertainty.patterns_mm, together.uncertainty.patterns_mm)
        assert found.metadata == parts[0].metadata


def test_a_part_that_cannot_be_written_leaves_no_file(both, tmp_path):
    _, parts, _ = both
    with pytest.raises(KeyboardInterrupt), write_cloud_in_parts(tmp_path / "parts.h5") as write:
        write(parts[0])
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
