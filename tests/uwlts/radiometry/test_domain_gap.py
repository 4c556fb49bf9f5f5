"""Statistics of drawn stripes, and the domain gap against closed forms and against halves of one set."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import uwlts
from uwlts.errors import CaptureError, DescriptionError, ImageError
from uwlts.radiometry.domain_gap import _set_gap
from uwlts.radiometry.stripe_windows import STATISTICS, StripeWindows, measure_windows, open_image_set

ETNA = Path(__file__).resolve().parents[2] / "data" / "etna"
NAMES = [each.name for each in STATISTICS]


def draw(
    rng: np.random.Generator, *, sigma_px: float = 3.0, scatter: float = 0.0, halo: float = 0.0, noise: float = 1.0
) -> np.ndarray:
    """Draw a stripe along the height, with the same scatter of light on each pair of lines."""
    lines, place = 320, np.arange(240)
    grains = np.repeat(1 + scatter * rng.standard_normal(lines // 2), 2)[:, None]
    away = place - (120 + 5 * np.sin(np.arange(lines) / 60))[:, None]
    light = 120 * np.maximum(grains, 0.05) * np.exp(-0.5 * (away / sigma_px) ** 2)
    light = light + 120 * halo * np.exp(-np.abs(away) / 15)
    return np.clip(np.rint(20 + light + rng.normal(0, noise, light.shape)), 0, 255).astype(np.uint8)


def write(folder: Path, images: list[np.ndarray]) -> Path:
    folder.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"{number}.png"), image)
    return folder


def windows(name: str, values: np.ndarray) -> StripeWindows:
    """Return windows of 40 images with one statistic that differs, and others that do not."""
    table = np.zeros((len(values), len(STATISTICS)))
    table[:, 0] = values
    return StripeWindows(name, table, np.repeat(np.arange(40), len(values) // 40), ())


def test_statistics_are_those_of_the_drawn_stripe(tmp_path: Path):
    rng = np.random.default_rng(1)
    images = [draw(rng, sigma_px=3.0, scatter=0.2, halo=0.05, noise=2.0) for _ in range(6)]
    found = measure_windows(open_image_set(write(tmp_path / "drawn", images)), most_images=10)
    assert found.values.shape == (30, len(STATISTICS)) and len(np.unique(found.image)) == 6
    median = dict(zip(NAMES, np.median(found.values, axis=0).tolist(), strict=True))
    # A Gaussian's full width at half maximum is 2.355 standard deviations; 0.3 px for the halo below it.
    assert median["width"] == pytest.approx(7.06, abs=0.3)
    assert median["background"] == pytest.approx(100 * 20 / 255, abs=0.3)
    assert median["noise"] == pytest.approx(100 * 2 / 255, rel=0.1)
    # 32 independent grains in a window give the standard deviation to 13 %, 30 windows its median to a few percent. The
    # parabola takes 3 of them, which is 5 %. Half of the neighbouring lines have the same grain.
    assert median["scatter"] == pytest.approx(20, rel=0.15)
    assert median["correlation"] == pytest.approx(0.5, abs=0.12)
    # The halo of 5 % falls to 1/e in 15 px, and is 0.05 exp(-28 / 15) = 0.8 % four widths away; 5 sigma of the pixels.
    assert 0.3 < median["halo"] < 1.5
    assert median["gaps"] == median["clipped"] == 0


def test_gap_of_shifted_normal_distributions():
    """Quantiles in the mixture, and all pairs: no other code of the gap is used for the expected value."""
    rng = np.random.default_rng(2)
    x, y = rng.normal(0, 1, 400), rng.normal(1.5, 1, 400)
    found = _set_gap(windows("generated", x), windows("real", y))
    pooled = np.concatenate([x, y])

    def quantile(values: np.ndarray) -> np.ndarray:
        return np.array([np.mean(pooled < v) + 0.5 * np.mean(pooled == v) for v in values])

    p, q = quantile(x), quantile(y)
    between = 2 * np.abs(p[:, None] - q).mean()
    within = sum(np.abs(each[:, None] - each).sum() / (400 * 399) for each in (p, q))
    expected = (between - within) / between
    assert found.gap == pytest.approx(expected, abs=1e-9)
    assert found.by_statistic["width"] == pytest.approx(expected, abs=1e-9)
    assert found.by_statistic["noise"] == 0
    # The generated range is -2.33 to 2.33: a share of Phi(0.83) = 0.80 of the real values; 0.1 is five sigma.
    assert found.covered["width"] == pytest.approx(0.80, abs=0.1) and found.covered["noise"] == 1
    assert 0 < found.std < 0.1


def test_uncertainty_of_the_gap_is_the_scatter_of_repeated_draws():
    """40 draws give their standard deviation to 11 %; three times that, and as much for the jackknife: 45 %."""
    rng = np.random.default_rng(3)
    shift = np.repeat(rng.normal(0, 1, (40, 2, 40)), 5, axis=2)
    found = [
        _set_gap(windows("a", rng.normal(0, 1, 200) + one), windows("b", rng.normal(1, 1, 200) + other))
        for one, other in shift
    ]
    scatter, stated = np.std([each.gap for each in found]), np.mean([each.std for each in found])
    assert stated == pytest.approx(scatter, rel=0.45)


def test_page_and_json_of_real_and_drawn_images(tmp_path: Path):
    rng = np.random.default_rng(4)
    clean = write(tmp_path / "clean", [draw(rng) for _ in range(6)])
    rough = write(tmp_path / "rough", [draw(rng, sigma_px=5.0, scatter=0.3, halo=0.1, noise=3.0) for _ in range(6)])
    alike = write(tmp_path / "alike", [draw(rng, sigma_px=5.0, scatter=0.3, halo=0.1, noise=3.0) for _ in range(6)])
    found = uwlts.report.write_domain_gap([clean, alike], real=[rough], out=tmp_path / "gap.html")
    gap = {each.name: each for each in found.gaps}
    (floor,) = found.floors
    # Equal distributions: within four standard uncertainties of 0, as the halves of one set are.
    assert abs(gap["alike"].gap) < 4 * max(gap["alike"].std, 0.02) and abs(floor.gap) < 0.1
    assert gap["clean"].gap > 0.3 > gap["alike"].gap
    assert gap["clean"].covered["width"] == 0 and gap["alike"].covered["width"] > 0.8
    page, record = (tmp_path / "gap.html").read_text(), json.loads((tmp_path / "gap.json").read_text())
    assert "rough" in page and "two halves" in page
    assert {each["name"]: each["windows"] for each in record["sets"]} == {"clean": 30, "alike": 30, "rough": 30}
    assert record["gaps"][0]["gap"] == pytest.approx(gap["clean"].gap)


def test_photographs_give_direction_and_saturation():
    found = open_image_set(ETNA)
    assert (found.stripe_along, found.full_dn, found.count) == ("height", 255.0, 16)
    table = measure_windows(found, most_images=2).values
    assert len(table) > 20
    # By eye the stripe is 20 to 30 px wide and white in its middle.
    assert 18 < np.median(table[:, NAMES.index("width")]) < 32
    assert np.median(table[:, NAMES.index("clipped")]) == 100


def test_windows_on_printed_edges_are_left_out(tmp_path: Path):
    """Edges from black to white are bright on one side to their brightest pixel; a stripe on such a board is kept."""
    rng = np.random.default_rng(6)
    board = np.where(np.arange(240) < 130, 40, 140)
    edges = [np.clip(rng.normal(cv2.GaussianBlur(np.tile(board, (320, 1)).astype(float), (0, 0), 3), 1), 0, 255)]
    # The lens sharpens edges: their brightest pixel is 30 grey values above the white.
    edges[0][:, 134:138] += 30
    stripes = [draw(rng), np.clip(draw(rng) + 0.2 * board, 0, 255)]
    images = [each.astype(np.uint8) for each in (*stripes, *edges)]
    found = measure_windows(open_image_set(write(tmp_path / "board", images)), most_images=5)
    assert np.unique(found.image).tolist() == [0, 1]


def test_sets_that_cannot_be_used_are_refused(tmp_path: Path):
    black = write(tmp_path / "black", [np.zeros((200, 300), np.uint8)])
    short = write(tmp_path / "short", [draw(np.random.default_rng(5))])
    out = tmp_path / "gap.html"
    with pytest.raises(DescriptionError, match="no images are given"):
        uwlts.report.write_domain_gap(out=out)
    with pytest.raises(ImageError, match="no stripe is found"):
        uwlts.report.write_domain_gap(real=[black], out=out)
    with pytest.raises(ImageError, match="has no images"):
        uwlts.report.write_domain_gap(real=[tmp_path], out=out)
    cv2.imwrite(str(short / "9.png"), np.full((200, 300), 4000, np.uint16))
    with pytest.raises(ImageError, match="give images of one camera"):
        uwlts.report.write_domain_gap(real=[short], out=out)
    (short / "9.png").unlink()
    with pytest.raises(CaptureError, match="shows 5 pieces of a stripe"):
        uwlts.report.write_domain_gap(real=[short], out=out)
    assert not out.exists()
