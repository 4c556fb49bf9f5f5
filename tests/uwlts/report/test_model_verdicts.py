"""Verdicts on models from held-out images: on the window only from those in water."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwlts.calibration.joint.residuals import STRIPE
from uwlts.calibration.model_comparison.comparison import Choice, Comparison, build_choice
from uwlts.calibration.model_comparison.held_out import INSIDE, OUTSIDE, Candidate, Misses, Prediction
from uwlts.report.model_comparison import make_content, models_page, verdicts

AIR, WATER = 0, 1
SINGLE = Candidate(refractions=1)
SCATTER_MM, MORE_MM = 0.02, 0.01


def chosen(*, dry: int, wet: int, more_in_water_mm: float) -> Choice:
    """Return a choice between a plate and a single refraction, which has an additional error for images in water.

    In air both predict the same. Equally many images are held out inside and outside.
    """
    ways = {
        where: frozenset([(AIR, start + n) for n in range(dry)] + [(WATER, start + n) for n in range(wet)])
        for where, start in ((INSIDE, 0), (OUTSIDE, 1000))
    }
    found = {}
    for candidate, more_mm in ((Candidate(), 0.0), (SINGLE, more_in_water_mm), (Candidate(bow=False), 0.0)):
        predicted = {}
        for where, held in ways.items():
            rng = np.random.default_rng(3)
            misses = []
            for image in sorted(held):
                off = rng.normal(0, SCATTER_MM, 200)
                # Of either sign by image, so that the sum of squares differs by the square of it but for chance.
                off = off + (more_mm * rng.choice([-1, 1]) if image[0] == WATER else 0.0)
                misses.append(Misses(image, STRIPE, np.abs(off) / 0.2, np.abs(off)))
            predicted[where] = Prediction(misses, SimpleNamespace(keys=()), np.empty(0), np.empty((0, 0)))
        found[candidate] = predicted
    return build_choice(found, ways, frozenset({WATER}))


def said_of_glass(choice: Choice) -> str:
    (line,) = (line for line in verdicts_of_parts(choice) if "the glass plate" in line)
    return line


def verdicts_of_parts(choice: Choice) -> list[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uwlts.report.model_comparison._describe_distortion", lambda *_: "k1 k2 is enough")
        return verdicts(choice)


@pytest.mark.parametrize("wet", [0, 3])
def test_images_in_air_do_not_show_that_the_glass_is_not_needed(wet):
    choice = chosen(dry=20, wet=wet, more_in_water_mm=0.0)
    line = said_of_glass(choice)
    assert line.startswith("whether the glass plate is needed is not shown") and f" {wet} are in water" in line
    # Verdicts that air supports are unchanged.
    assert any(line.startswith("the bow of the sheet is not needed") for line in verdicts_of_parts(choice))


def test_images_in_water_show_that_the_glass_is_not_needed():
    line = said_of_glass(chosen(dry=20, wet=6, more_in_water_mm=0.0))
    assert line == (
        "the glass plate is not needed: with a single refraction 12 images held out in water are predicted as well"
    )


def test_few_images_in_water_tell_that_the_glass_is_needed_among_many_in_air():
    """For 5 images in water, 1,000 values, the excess 0.01² is 8 of its standard errors above 0.

    The standard error is 2 * 0.02 * 0.01 / sqrt(1000) = 1.3e-5 mm², against 1e-4.
    """
    line = said_of_glass(chosen(dry=200, wet=5, more_in_water_mm=MORE_MM))
    assert line.startswith("the glass plate is needed: with a single refraction points"), line


def test_long_names_of_models_wrap_in_the_page():
    """A table of 15 columns is as wide as the page only if its names break; a narrower page scrolls it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uwlts.report.model_comparison._describe_distortion", lambda *_: "k1 k2 is enough")
        content = make_content(
            Comparison("thesis", ["a.h5"], chosen(dry=8, wet=8, more_in_water_mm=0.0), None, "none", [])
        )
    page = models_page(content)
    style = page[page.rindex("main { max-width: 1340px; }") : page.index("</style>")]
    assert "td.words { white-space: normal;" in style
    assert page.count('<div class="wide"><table>') == 1
