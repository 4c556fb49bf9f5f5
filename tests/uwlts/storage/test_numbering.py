"""Numbers in names count one scan; encoder counts continue where the counter passes the end of its range."""

import re
from datetime import datetime, timedelta

import numpy as np
import pytest

from uwlts.errors import DescriptionError
from uwlts.storage.numbering import count_names, time_gaps, unwrap_counts


@pytest.mark.parametrize("form", ["scan{}_{:03d}.png", "{}/laser_{}.png", "2024-05-0{}_{:04d}.tif"])
@pytest.mark.parametrize("first", [0, 1])
def test_numbers_that_start_again_are_refused(form: str, first: int):
    names = [form.format(scan, number) for scan in (1, 2, 3) for number in range(first, first + 40 + scan)]
    with pytest.raises(DescriptionError, match="are the last and first of two scans: narrow the patterns"):
        count_names(names)
    assert count_names(names, series=True) is None
    # Numbers that continue are those of one scan.
    continued = count_names([form.format(1 + (number > 20), number) for number in range(first, 40)])
    assert continued is not None and continued.places()[-1] == 39 - first


@pytest.mark.parametrize("form", ["%Y-%m-%d_%H-%M-%S", "%H%M%S-%f", "%H-%M-%S_%f"])
@pytest.mark.parametrize("step_s", [0.04, 1.0, 1.5, 2.0, 7.3, 10.0])
def test_times_in_names_are_no_counts_that_start_again(form: str, step_s: float):
    """The clock passes minutes and an hour; the first second is 0, where counts begin too."""
    begin = datetime(2024, 5, 1, 10, 58, 0, 123456)
    times = [(begin + timedelta(seconds=step_s * number)).strftime(form) for number in range(400)]
    count_names(list(dict.fromkeys(times)))


@pytest.mark.parametrize(
    ("form", "numbers", "last"),
    [
        ("frame{:04d}.png", np.arange(12), 11),
        ("{}_laser_exp5.png", 5 * np.arange(12), 11),
        # Positions with a decimal point, also from 0, and nanoseconds.
        ("laser_{:.2f}mm.png", 0.25 * np.arange(3, 15), 11),
        ("laser_{:.1f}mm.png", 0.5 * np.arange(12), 11),
        ("{}.png", 1_717_243_200_000_000_005 + 250_000_007 * np.arange(12), 11),
    ],
)
def test_numbers_in_names_show_an_image_that_is_missing(form, numbers, last):
    counted = count_names([form.format(number) for number in np.delete(numbers, 6)])
    assert counted is not None and counted.places().tolist() == [*range(6), *range(7, last + 1)]


@pytest.mark.parametrize(("form", "unit_s"), [("{:.6f}.png", 1.0), ("{:.0f}.png", 1e-3), ("a/cam0_{:.0f}.png", 1e-9)])
def test_times_in_names_show_an_image_that_is_missing(form, unit_s):
    rng = np.random.default_rng(3)
    times_s = 1_717_243_200 + 0.25 * np.arange(12) + rng.uniform(0, 0.005, 12)
    names = [form.format(time_s / unit_s) for time_s in times_s]
    assert time_gaps(names, np.full(12, np.nan)) == []
    lost = names[:6] + names[7:]
    assert count_names(lost) is None
    (said,) = time_gaps(lost, np.full(11, np.nan))
    assert re.match(r"the times jump by 0\.(5|49)\d* s after image 6, .* usually by 0\.2", said)


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
    lost = np.concatenate([np.arange(0, 400, 10), np.arange(900, 1300, 10), np.arange(1295, 1290, -1)])
    assert np.array_equal(unwrap_counts(lost), lost)
