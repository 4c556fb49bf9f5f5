"""The cloud of bounded size: the points kept of pieces of any size."""

import threading

import numpy as np
import pytest
from hypothesis import given, strategies as st

from uwlts.desk.shown_state import FIELDS, ThinnedCloud, pack

PIECES = st.lists(st.integers(0, 60), max_size=30)


def points(first: int, count: int) -> np.ndarray:
    """Points that contain their index in the order of adding."""
    number = np.arange(first, first + count, dtype=float)
    return np.column_stack([number, number + 0.25, -number])


def filled(at_most: int, sizes: list[int]) -> ThinnedCloud:
    cloud, total = ThinnedCloud(at_most), 0
    for size in sizes:
        piece = points(total, size)
        # A field that some pieces lack.
        known = None if size % 2 else piece[:, 0] + 0.5
        cloud.add(piece, intensity=2 * piece[:, 0], deviation=known)
        total += size
    return cloud


@given(at_most=st.integers(1, 50), sizes=PIECES)
def test_every_nth_of_all_points_is_kept_in_order(at_most: int, sizes: list[int]):
    cloud, total = filled(at_most, sizes), sum(sizes)
    kept = cloud.points()
    assert cloud.total == total and cloud.version == len(sizes) and len(kept) <= at_most
    # The smallest power of two that keeps at most the wanted number, whatever the pieces.
    stride = 1
    while -(-total // stride) > at_most:
        stride *= 2
    expected = np.arange(0, total, stride, dtype=float)
    np.testing.assert_array_equal(kept[:, :3], np.column_stack([expected, expected + 0.25, -expected]))


@given(at_most=st.integers(1, 50), sizes=PIECES)
def test_fields_stay_with_their_points(at_most: int, sizes: list[int]):
    kept = filled(at_most, sizes).points()
    assert FIELDS == ("intensity", "deviation", "random", "common")
    np.testing.assert_array_equal(kept[:, 3], 2 * kept[:, 0])
    ends = np.cumsum(sizes)
    piece = np.searchsorted(ends, kept[:, 0], side="right")
    unknown = np.array([sizes[k] % 2 == 1 for k in piece], dtype=bool)
    np.testing.assert_array_equal(kept[:, 4], np.where(unknown, np.nan, kept[:, 0] + 0.5))
    assert np.isnan(kept[:, 5:]).all()


@given(at_most=st.integers(1, 50), sizes=PIECES, far=st.sampled_from([0.0, 1e6, -3e7]))
def test_packed_points_are_unpacked_unchanged(at_most: int, sizes: list[int], far: float):
    cloud, total = ThinnedCloud(at_most), 0
    for size in sizes:
        piece = points(total, size) + [far, 0, -far]
        cloud.add(piece, random=np.full(size, 0.125))
        total += size
    origin, data = pack(cloud.points())
    kept, table = cloud.points(), np.frombuffer(data, "<f4").reshape(-1, 7)
    assert origin.shape == (3,) and (origin == np.round(origin)).all()
    assert len(table) == len(kept)
    # Relative to the origin coordinates are small, so that a float32 keeps them to some um for distant clouds, too.
    np.testing.assert_allclose(table[:, :3] + origin, kept[:, :3], rtol=0, atol=2e-4)
    assert (table[:, 5] == 0.125).all() and np.isnan(table[:, [3, 4, 6]]).all()
    if len(kept):
        np.testing.assert_allclose(origin, np.median(kept[:, :3], axis=0), atol=0.5)


@given(at_most=st.integers(1, 50), sizes=PIECES, thinned_by=st.integers(1, 7))
def test_points_count_as_many_as_they_represent(at_most: int, sizes: list[int], thinned_by: int):
    cloud, total = ThinnedCloud(at_most), 0
    for size in sizes:
        cloud.add(points(total, size), of=size * thinned_by)
        total += size
    assert cloud.total == thinned_by * total
    np.testing.assert_array_equal(cloud.points()[:, :3], filled(at_most, sizes).points()[:, :3])


def test_an_empty_cloud_is_packed_too():
    origin, data = pack(ThinnedCloud().points())
    assert origin.tolist() == [0, 0, 0] and data == b""


def test_clearing_restarts():
    cloud = filled(10, [35])
    cloud.clear()
    assert (cloud.total, len(cloud.points()), cloud.version) == (0, 0, 2)
    cloud.add(points(0, 10))
    assert cloud.points()[:, 0].tolist() == list(range(10))


def test_earlier_results_are_not_changed():
    cloud = filled(100, [20])
    before = cloud.points()
    before[:] = 0
    cloud.add(points(20, 5))
    assert cloud.points()[:, 0].tolist() == list(range(25))


def test_an_unusual_kind_of_numbers_is_taken():
    cloud = ThinnedCloud(10)
    cloud.add(np.ones((3, 3), np.float32), intensity=np.array([1, 2, 3], np.uint16))
    assert cloud.points()[:, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize("at_most", [7, 1000])
def test_several_threads_may_add_and_look(at_most: int):
    cloud, seen = ThinnedCloud(at_most), []

    def add() -> None:
        for _ in range(200):
            cloud.add(np.full((13, 3), 5.0))

    adding = [threading.Thread(target=add) for _ in range(4)]
    for thread in adding:
        thread.start()
    while any(thread.is_alive() for thread in adding):
        seen.append(cloud.points())
    for thread in adding:
        thread.join()
    assert cloud.total == 4 * 200 * 13 and cloud.version == 800
    assert all(len(kept) <= at_most and (kept[:, :3] == 5).all() for kept in [*seen, cloud.points()])
