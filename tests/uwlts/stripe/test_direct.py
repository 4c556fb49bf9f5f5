"""Direct stripe of the laser among reflections, in drawn images (rendered: `docs/studies/stripe_reflections.py`)."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from uwlts.model.library import load_sensor
from uwlts.stripe import StripeOptions, extract_candidates, extract_stripe, find_stripes

LINES, LENGTH = 400, 320
BRIGHTEST = StripeOptions(peak="strongest", ambiguous_ratio=1.0)
NOISE = 1.0


def drawn(*stripes: tuple[np.ndarray, float], seed: int = 3) -> np.ndarray:
    """Draw (LENGTH, LINES) uint8: stripes of sigma 2 px at places (LINES,), NaN for none, of given heights."""
    rows = np.arange(LENGTH)[:, None]
    light = sum(np.nan_to_num(height * np.exp(-0.5 * ((rows - place) / 2.0) ** 2)) for place, height in stripes)
    noise = np.random.default_rng(seed).normal(0, NOISE, (LENGTH, LINES))
    return np.clip(np.rint(10 + light + noise), 0, 255).astype(np.uint8)


def on(first: int, last: int, place: np.ndarray) -> np.ndarray:
    """Return the places on a range of lines, NaN elsewhere."""
    lines = np.arange(LINES)
    return np.where((lines >= first) & (lines < last), place, np.nan)


def found(*images: np.ndarray, options: StripeOptions = StripeOptions(), sensor: str = "thesis"):
    """Return the stripes found by `find_stripes` in images of one recording."""
    count = len(images)
    header = SimpleNamespace(sensor=load_sensor(sensor), saturation_dn=255)
    about = {"laser_on": np.ones(count, bool), "stage_mm": np.arange(float(count))}
    about |= {"exposure_ms": np.ones(count), "pose": np.full((count, 4, 4), np.nan), "path": Path("drawn.h5")}

    class Images(SimpleNamespace):
        def __len__(self) -> int:
            return count

    capture = Images(header=header, image=images.__getitem__, **about)
    return find_stripes(capture, options=options)


X = np.arange(LINES)
FLOOR, WALL = on(0, 200, 240 - 0.1 * X), on(200, 280, 220 - 1.5 * (X - 200))
TOP, REFLECTED = on(280, LINES, 100 - 0.1 * (X - 280)), on(200, 270, 240 - 0.1 * X)


def test_the_wall_of_a_shining_corner_is_taken_and_the_floor_in_it_is_not():
    """The wall reflects the floor, eight times as bright as itself, in continuation of the floor's own stripe."""
    image = drawn((FLOOR, 120), (WALL, 15), (TOP, 100), (REFLECTED, 110))
    true = np.nanmax([FLOOR, WALL, TOP], axis=0)
    stripes, brightest = found(image), found(image, options=BRIGHTEST)
    wrong = np.abs(stripes.centre_px - true[stripes.line]) > 3
    assert not wrong.any()
    assert np.mean(np.abs(brightest.centre_px - true[brightest.line]) > 3) > 0.1
    # No stripe is taken near the merging point: 16 lines on either side of the corner at a slope of 1.4 px per line.
    assert len(stripes.line) > LINES - 2 * 16 - 12
    assert np.count_nonzero((stripes.line > 220) & (stripes.line < 275)) > 45


def test_a_reflection_below_a_mirrors_faint_stripe_is_left_out():
    """The faint stripe extends beyond the bright one, which begins and ends without a connection to it."""
    mirror, arc = on(0, LINES, 150 + 0.1 * X), on(120, 220, 260 - 0.01 * (X - 170) ** 2)
    stripes = found(drawn((mirror, 10), (arc, 90)))
    assert np.abs(stripes.centre_px - mirror[stripes.line]).max() < 3
    assert len(stripes.line) > 0.9 * LINES


def test_a_reflection_beside_a_stripe_that_is_too_wide_is_not_taken():
    """On some lines the stripe is too wide to be measured, with a dim, sharp peak elsewhere."""
    glare, spot = on(150, 210, 150 + 0 * X), on(155, 205, 260 + 0 * X)
    floor = np.where(np.isnan(glare), 150.0, np.nan)
    rows = np.arange(LENGTH)[:, None]
    wide = np.nan_to_num(200 * np.exp(-0.5 * ((rows - glare) / 10.0) ** 2))
    image = np.clip(drawn((floor, 60), (spot, 20)) + wide, 0, 255).astype(np.uint8)
    stripes, brightest = found(image), found(image, options=BRIGHTEST)
    assert np.abs(stripes.centre_px - 150).max() < 3 and len(stripes.line) > LINES - 70
    assert np.count_nonzero(np.abs(brightest.centre_px - 150) > 3) > 40


def test_the_rest_of_a_reflection_is_not_taken_where_the_wall_is_too_dark_to_be_seen():
    """The wall is invisible over its last fifth, with the reflected floor alone on these lines."""
    wall = on(200, 264, 220 - 1.5 * (X - 200))
    stripes = found(drawn((FLOOR, 120), (wall, 15), (TOP, 100), (on(200, 280, 240 - 0.1 * X), 110)))
    true = np.fmax(np.fmax(FLOOR, wall), TOP)[stripes.line]
    assert (np.abs(stripes.centre_px - true) < 3).all() and len(stripes.line) > 330


def test_the_floor_in_a_wall_that_is_seen_in_pieces_is_not_taken():
    """Another reflection is in front of the floor, so that the floor's own stripe is behind it on either side."""
    wall = np.where((X > 236) & (X < 254), np.nan, on(200, 264, 220 - 1.5 * (X - 200)))
    ghost, reflected = on(60, 140, 220 - 0.35 * (200 - X)), on(200, 320, 240 - 0.1 * X)
    true = np.fmax(np.fmax(FLOOR, wall), TOP)
    for seed in range(4):
        stripes = found(drawn((FLOOR, 80), (wall, 20), (TOP, 40), (ghost, 50), (reflected, 70), seed=seed))
        assert (np.abs(stripes.centre_px - true[stripes.line]) < 3).all()
        assert len(stripes.line) > 280


def test_a_dimmer_stripe_before_the_floor_that_nothing_joins_is_a_reflection():
    """A wall facing the camera reflects the floor, nearer and dimmer than it is."""
    floor, ghost = on(0, LINES, 200 + 0.05 * X), on(30, 350, 120 + 0.05 * X)
    stripes = found(drawn((floor, 120), (ghost, 45)))
    assert np.abs(stripes.centre_px - floor[stripes.line]).max() < 3
    assert len(stripes.line) > 0.95 * LINES


@pytest.mark.parametrize("place", [on(0, LINES, 150 + 40 * np.sin(X / 50)), FLOOR])
def test_images_with_one_stripe_give_what_extraction_gives(place):
    image = drawn((place, 80))
    alone, stripes = extract_stripe(image, stripe_along="width", saturation=255), found(image, image)
    for frame in (0, 1):
        here = stripes[stripes.frame == frame]
        np.testing.assert_array_equal(here.line, alone.lines)
        np.testing.assert_array_equal(here.centre_px, alone.centre_px[alone.lines])


def test_a_rod_before_a_floor_and_a_groove_in_it_stay():
    floor = on(0, LINES, 200 + 0 * X)
    for place in (120.0, 260.0):
        piece = on(150, 190, place + 0 * X)
        true = np.where(np.isnan(piece), floor, piece)
        stripes = found(drawn((true, 100)))
        assert np.abs(stripes.centre_px - true[stripes.line]).max() < 1
        assert len(stripes.line) >= LINES - 8  # two lines on either side of each of both jumps


def test_a_block_whose_edges_show_the_floor_beside_it_stays():
    """On the two lines of its edges both stripes are visible, and either may be the laser's own."""
    block, floor = on(150, 260, 120 + 0 * X), np.fmax.reduce([on(0, 151, 200 + 0 * X), on(259, LINES, 200 + 0 * X)])
    stripes = found(drawn((block, 60), (floor, 80)))
    true = np.where(np.isnan(block), floor, block)
    inside = ~np.isin(stripes.line, (150, 259))
    assert np.abs(stripes.centre_px - true[stripes.line])[inside].max() < 3
    assert np.count_nonzero(np.isin(stripes.line, np.arange(151, 259))) > 100


def test_all_stripes_of_two_sheets_are_candidates_in_their_order():
    near, far = 100 + 0.1 * X, 180 + 0.05 * X
    candidates = extract_candidates(drawn((near, 60), (on(0, 300, far), 140)), stripe_along="width", saturation=255)
    assert (np.diff(candidates.line) >= 0).all()
    both = np.isin(candidates.line, np.flatnonzero(np.bincount(candidates.line, minlength=LINES) == 2))
    first, second = candidates[both][::2], candidates[both][1::2]
    assert np.isin(np.arange(300), first.line).mean() > 0.99 and first.line.max() < 300
    for stripe, place in ((first, near), (second, far)):
        # Noise of one level on 60: Cramer-Rao bound 0.02 px; more than five times that.
        assert np.abs(stripe.centre_px - place[stripe.line]).max() < 0.12
    # The likelihoods differ by the ratio of the squared heights.
    likelihood = candidates.log_likelihood[candidates.line == 150]
    assert likelihood[1] / likelihood[0] == pytest.approx((140 / 60) ** 2, rel=0.3)
