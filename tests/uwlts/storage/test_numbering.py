"""Encoder counts continue where the counter passes the end of its range."""

import numpy as np
import pytest

from uwlts.errors import DescriptionError
from uwlts.storage.numbering import unwrap_counts


def wrapped(counts: np.ndarray, bits: int, *, signed: bool) -> np.ndarray:
    low = -(2 ** (bits - 1)) if signed else 0
    return (counts - low) % 2**bits + low


@pytest.mark.parametrize("bits", [16, 24, 32])
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("told", [False, True])
def test_a_counter_that_passes_its_end_continues(bits, signed, direction, told):
    rng = np.random.default_rng(bits)
    start = (2 ** (bits - 1) if signed else 2**bits) - 500
    # A third of the range in equal steps, with a vibration, in either direction past the end.
    true = start + direction * (np.arange(-50, 51) * (2**bits // 300) + rng.integers(-3, 4, 101))
    found = unwrap_counts(wrapped(true, bits, signed=signed), bits if told else None)
    assert np.array_equal(found - found[0], true - true[0])


def test_a_stage_at_rest_that_vibrates_about_zero():
    counts = np.array([2, 1, 0, 2**32 - 1, 0, 2**32 - 2, 1])
    assert unwrap_counts(counts).tolist() == [2, 1, 0, -1, 0, -2, 1]


def test_counts_without_overflow_are_unchanged():
    for counts in ([100, 180, -20], [5], [], np.concatenate([np.arange(0, 30_000, 10), np.arange(30_000, 0, -10)])):
        assert np.array_equal(unwrap_counts(np.array(counts, float)), counts)


def test_a_jump_that_is_not_plain_is_refused_unless_the_width_is_stated():
    counts = np.concatenate([np.arange(40_000, 40_400), np.arange(200, 600)])
    with pytest.raises(DescriptionError, match=r"jumps from 40399 to 200: give the width .*encoder_bits"):
        unwrap_counts(counts)
    with pytest.raises(DescriptionError, match="its counter started again"):
        unwrap_counts(counts, 32)
    assert unwrap_counts(counts, 16)[-1] == 65_536 + 599
    with pytest.raises(DescriptionError, match="more than its 8 bits"):
        unwrap_counts(counts, 8)


@pytest.mark.parametrize("start", [0, 7000])
def test_a_counter_that_starts_again_is_refused(start):
    counts = np.concatenate([start + np.arange(0, 400, 10), start + np.arange(0, 300, 10)])
    with pytest.raises(DescriptionError, match=f"jumps back from {start + 390} to {start} after image 40"):
        unwrap_counts(counts)
    assert np.array_equal(unwrap_counts(counts, returns=True), counts)
    lost = np.concatenate([np.arange(0, 400, 10), np.arange(900, 1300, 10), np.arange(1295, 1290, -1)])
    assert np.array_equal(unwrap_counts(lost), lost)
