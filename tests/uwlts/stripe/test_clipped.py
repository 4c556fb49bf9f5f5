"""Marks of clipped pixels: kept with the grey values, found only where a program wrote them."""

import numpy as np
import pytest

from uwlts.stripe.exposures import has_marks, mark_clipped, split_clipped


@pytest.mark.parametrize("bits", [9, 11, 15])
def test_values_and_marks_come_back(bits):
    rng = np.random.default_rng(bits)
    full = 2**bits - 1
    values, clipped = rng.integers(0, full, (40, 30), np.uint16), rng.random((40, 30)) < 0.1
    marked = mark_clipped(values, clipped, saturation_dn=full)
    found = split_clipped(marked, full)
    assert np.array_equal(found[0], values) and np.array_equal(found[1], clipped)
    # Programs that do not know of marks see that the pixels are clipped.
    assert np.array_equal(marked >= full, clipped)
    # A cut keeps its marks.
    assert np.array_equal(split_clipped(marked[7:, 3:9], full)[1], clipped[7:, 3:9])


@pytest.mark.parametrize(
    ("image", "saturation"),
    [
        (np.full((3, 4), 255, np.uint8), 127.0),
        (np.full((3, 4), 4095, np.uint16), 4095),
        (np.full((3, 4), 4095, np.uint16), 4000),
        (np.full((3, 4), 65535, np.uint16), 65535),
        (np.full((3, 4), 700, np.float32), 511.0),
        (np.full((3, 4), 700, np.float32), np.inf),
    ],
)
def test_images_of_cameras_are_left_as_they_are(image, saturation):
    assert not has_marks(image, saturation)
    values, clipped = split_clipped(image, saturation)
    assert values is image and clipped.all() == (saturation < np.inf)
