"""A laser that is bumped during a capture is noticed by both calibrations; errors of a sheet at rest are not."""

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor, lattice, stage_images, stripes_on_target
from tests.uwlts.joint_views import TARGET, gathered
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.capture_evidence import AirEvidence
from uwlts.calibration.joint.gathering import Series
from uwlts.calibration.joint.parameters import ViewMedium
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, Evidence, solve
from uwlts.calibration.target_stripes import find_step

BARE = altered(built_sensor(), {"camera": {"window": {"mounted": False}}})
OPTIONS = CalibrationOptions(correct_circles=False, poses="stage", lens=LensChoice())


def images_of(seed, *, bumped_at=None, by_mm=0.0, turned_deg=0.0, count=10):
    """Return images of the target on the stage; the laser's parts move before the image ``bumped_at``."""
    rng = np.random.default_rng([60, seed])
    images, poses, _ = stage_images(
        BARE, positions=np.linspace(0, 270, count), noise_px=0.05, rng=rng, points=lattice(9, 9)
    )
    laser = BARE.laser
    assert laser.baseline_mm is not None
    moved = {"baseline_mm": laser.baseline_mm + by_mm, "roll_deg": laser.roll_deg + turned_deg}
    first = count if bumped_at is None else bumped_at
    stripes = [
        *stripes_on_target(BARE, poses[:first], count=300, noise_px=0.15, rng=rng),
        *stripes_on_target(altered(BARE, {"laser": moved}), poses[first:], count=300, noise_px=0.15, rng=rng),
    ]
    frames = [(0, number) for number in range(count)]
    return AirEvidence(TARGET, images, frames, stripes, [], outliers=[0] * count, captures=["air.h5"])


def said_by(how, found):
    if how == "joint":
        warnings = solve_jointly(
            gathered(BARE, [Series(ViewMedium(False, None), found, True)]), options=OPTIONS
        ).warnings
    else:
        warnings = solve(Evidence(BARE, "air", np.eye(3)[2], True, found, None, [], {}, []), options=OPTIONS).warnings
    return [each for each in warnings if "the laser sheet moved" in each]


@pytest.mark.parametrize("how", ["joint", "sequential"])
@pytest.mark.parametrize("move", [{"bumped_at": 5, "by_mm": 0.54}, {"bumped_at": 3, "turned_deg": 0.15}])
def test_a_laser_that_is_bumped_is_noticed(how, move):
    (said,) = said_by(how, images_of(1, **move))
    assert said.startswith(f"air.h5, frame {move['bumped_at']}: ")


@pytest.mark.parametrize("how", ["joint", "sequential"])
def test_a_laser_at_rest_is_not_doubted(how):
    assert said_by(how, images_of(2)) == []


def test_no_false_alarms_from_noise_and_smooth_errors():
    """Of 2000 drawn captures, 2 are doubted by chance, and more than 10 once in 100,000 times."""
    rng, doubted = np.random.default_rng(61), 0
    for _ in range(2000):
        places = np.sort(rng.uniform(-1, 1, int(rng.integers(7, 40))))
        smooth = np.polynomial.legendre.legval(places, rng.normal(0, [1, 1, 1, 0.1, 0.1]))
        noise = rng.uniform(0.01, 1) * rng.normal(size=(len(places), 2))
        doubted += find_step(places, smooth[:, None] * rng.normal(1, 0.3, 2) + noise) is not None
    assert doubted <= 10


def test_a_wrong_image_at_the_end_is_no_move():
    places = np.linspace(-1, 1, 12)
    distances = np.random.default_rng(62).normal(0, 0.01, (12, 2)) + np.where(np.arange(12) == 11, 1.0, 0.0)[:, None]
    assert find_step(places, distances) is None
    distances[6:] += 1.0
    assert (find_step(places[:11], distances[:11]) or (0, 0.0))[0] == 6
