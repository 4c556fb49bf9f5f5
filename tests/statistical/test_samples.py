"""Samples per pixel: the rendered mean is unbiased pixel by pixel, and converges faster than random samples."""

import numpy as np
import pytest
from scipy import stats

from tests.virtual_sensors import altered, clear, cropped, plate, scene_of, sensor_at
from twin.renderer import Renderer

SEEDS = 48


@pytest.fixture(scope="module")
def renderer(thesis):
    return Renderer(cropped(thesis, 64, 64), clear(0.3), scene_of(plate()))


@pytest.fixture(scope="module")
def reference(renderer):
    """Irradiance with 12288 samples per pixel."""
    images = [renderer.irradiance("laser", sensor_at(), spp=4096, seed=1000 + k).astype(float) for k in range(3)]
    return np.mean(images, axis=0)


@pytest.fixture(scope="module")
def stripe(reference):
    """The stripe's pixels, where brighter than 1 % of its middle."""
    chosen = reference > 0.01 * reference.max()
    assert 300 < chosen.sum() < 600
    return chosen


def seeds(renderer: Renderer, stripe: np.ndarray, spp: int) -> np.ndarray:
    """Irradiance of the stripe's pixels for many seeds, (SEEDS, P)."""
    return np.stack([renderer.irradiance("laser", sensor_at(), spp=spp, seed=k)[stripe].astype(float) for k in range(SEEDS)])


def scores(samples: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Student's t of every pixel's mean against its reference."""
    return (samples.mean(axis=0) - reference) / (samples.std(axis=0, ddof=1) / np.sqrt(len(samples)))


def agree(t: np.ndarray) -> bool:
    """Whether the pixels' t behave as Student's distribution demands, allowing for how many there are.

    Pixels take their samples independently. The largest of P values exceeds the bound once in 10^5 such tests, mean
    and mean square lie outside of five standard deviations once in 10^6.
    """
    freedom, count = SEEDS - 1, len(t)
    largest = stats.t.ppf(1 - 0.5e-5 / count, freedom)
    spread = freedom / (freedom - 2)
    return bool(
        np.abs(t).max() < largest
        and abs(t.mean()) < 5 * np.sqrt(spread / count)
        and abs((t**2).mean() / spread - 1) < 5 * np.sqrt(2 / count)
    )


@pytest.mark.parametrize("spp", [1, 4])
def test_every_pixels_mean_over_seeds_is_the_reference(renderer, reference, stripe, spp):
    samples, expected = seeds(renderer, stripe, spp), reference[stripe]
    assert agree(scores(samples, expected))
    # One pixel of some 400 wrong by six of its errors, or all by a fifth of theirs, would be noticed.
    error = samples.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    one = expected.copy()
    one[0] += 9 * error[0]
    assert not agree(scores(samples, one))
    assert not agree(scores(samples, expected + 0.5 * error))


def test_more_samples_help_more_than_random_ones_would(renderer, stripe):
    variances = [seeds(renderer, stripe, spp).var(axis=0, ddof=1).sum() for spp in (2, 8, 32)]
    # Random samples would lower the variance by 4 each time; these, evenly spread, by 16 where the picture is smooth.
    # A variance summed over 400 pixels of 48 seeds is known to 2 %: an eighth is far from a quarter.
    assert variances[1] < variances[0] / 8
    assert variances[2] < variances[1] / 8


@pytest.mark.parametrize("along", ["width", "height"])
def test_sixteen_samples_find_the_stripes_centre(thesis, along):
    # The detector's noise leaves some 0.02 px of a stripe's centre; samples must add far less than that.
    sensor = altered(thesis, {"camera": {"stripe_along": along, "width_px": 64, "height_px": 64}})
    renderer = Renderer(sensor, clear(0.3), scene_of(plate()))
    images = [renderer.irradiance("laser", sensor_at(), spp=16, seed=k).astype(float) for k in range(16)]
    if along == "height":
        images = [image.T for image in images]
    centres = np.array([np.arange(64) @ image / image.sum(axis=0) for image in images])
    assert centres.std(axis=0, ddof=1).max() < 0.002


@pytest.mark.parametrize("spp", [3, 5])
def test_an_odd_number_of_samples_is_as_fair(renderer, reference, stripe, spp):
    assert agree(scores(seeds(renderer, stripe, spp), reference[stripe]))


def test_seeds_repeat_and_differ(renderer, stripe):
    first, again, other = (renderer.irradiance("laser", sensor_at(), spp=4, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert (first[stripe] != other[stripe]).mean() > 0.99
