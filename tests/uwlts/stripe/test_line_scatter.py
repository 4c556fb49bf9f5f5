"""The default method against the simple ones, on stripes that its noise model describes and on others."""

from pathlib import Path

import numpy as np
import pytest

from uwlts.storage.image_file import read_image
from uwlts.stripe import PeakRule, StripeOptions, extract_stripe, method_names

DATA = Path(__file__).resolve().parents[2] / "data"
SIMPLE = [name for name in method_names() if name != StripeOptions().method]


def scatter(centre: np.ndarray) -> float:
    """Return the mean distance, px, of centres from parabolas through the twelve lines on either side, left out.

    A fit by another routine, over other lines than those of `uwlts.stripe.methods.profile_fit`.
    """
    found = []
    for line in range(12, len(centre) - 12):
        near = np.r_[line - 12 : line, line + 1 : line + 13]
        if np.isfinite(centre[near]).all() and np.isfinite(centre[line]) and np.ptp(centre[near]) < 12:
            found.append(abs(centre[line] - np.polyval(np.polyfit(near - line, centre[near], 2), 0)))
    assert len(found) > 100
    return float(np.mean(found))


def of_every_method(image: np.ndarray, **settings) -> dict[str, float]:
    """Return the scatter of each method on the lines that all of them find."""
    centres = {}
    for method in method_names():
        options = StripeOptions(method=method, **settings)
        centres[method] = extract_stripe(image, stripe_along="height", options=options).centre_px
    found = np.isfinite(list(centres.values())).all(axis=0)
    return {method: scatter(np.where(found, values, np.nan)) for method, values in centres.items()}


def real(name: str) -> np.ndarray:
    image = read_image(DATA / name)
    return image if image.ndim == 2 else np.ascontiguousarray(image[:, :, 2])


@pytest.mark.parametrize(
    ("name", "peak"),
    [
        ("ciclop/board/laser_x200_y440.png", PeakRule.FIRST),
        ("ciclop/board/laser_x200_y440.png", PeakRule.LAST),
        ("etna/frame0009.jpg", PeakRule.STRONGEST),
        ("etna/frame0013.jpg", PeakRule.STRONGEST),
    ],
)
def test_the_default_is_as_good_as_the_best_simple_method_on_real_stripes(name, peak):
    found = of_every_method(real(name), peak=peak)
    # The noise model alone scatters 1.7 times as much on the board.
    assert found[StripeOptions().method] < 1.03 * min(found[method] for method in SIMPLE)


def test_the_noise_model_is_used_in_speckle():
    rng = np.random.default_rng(8)
    centre = 60 + 6 * np.sin(np.arange(600) / 90)
    light = 120 * np.exp(-0.5 * ((np.arange(120) - centre[:, None]) / 2.0) ** 2) * rng.gamma(11.0, 1 / 11.0, (600, 120))
    image = np.clip(np.rint(light + 5 + rng.normal(0, 0.8, light.shape)), 0, 255).astype(np.uint8)
    found = of_every_method(image)
    assert found[StripeOptions().method] < 0.8 * min(found[method] for method in SIMPLE)
