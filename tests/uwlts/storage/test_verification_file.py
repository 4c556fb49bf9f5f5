"""The verdict of a verification is kept beside the calibration, and read by the reconstruction."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

import uwlts
from tests.uwlts.reconstruction.test_moving import record
from tests.uwlts.reconstruction.test_reconstruct import CALIBRATION
from uwlts.model.calibration import calibration_digest
from uwlts.reconstruction.verify import Verdict, Verification
from uwlts.storage.calibration_file import describe_verification

VERDICT = {"quantity": "diameter", "calibrated_mm": 50.0, "calibrated_expanded_mm": 0.01, "measured_expanded_mm": 0.02}


def verified(path, calibration, *, measured_mm=50.001):
    verdict = Verdict(**VERDICT, measured_mm=measured_mm, limit_mm=None)
    return Verification((verdict,), (), "check.h5", calibration_digest(calibration)).save(path)


@pytest.fixture
def dated(tmp_path):
    """A calibration made ten days ago, in a file."""
    made = (datetime.now(UTC) - timedelta(days=10)).isoformat()
    calibration = CALIBRATION.model_copy(update={"provenance": CALIBRATION.provenance | {"date": made}})
    calibration.save(tmp_path / "water.json")
    return tmp_path / "water.json", calibration


def test_a_calibration_without_verification_is_doubted_after_a_day(dated):
    path, calibration = dated
    assert "not verified since" in describe_verification(path, calibration)[1][0]
    made = datetime.fromisoformat(calibration.provenance["date"])
    assert describe_verification(path, calibration, now=made + timedelta(hours=23)) == (None, [])
    assert describe_verification(path, CALIBRATION) == (None, []), "without a date"


def test_a_verification_is_valid_for_a_day_and_for_its_calibration(dated, caplog):
    path, calibration = dated
    assert verified(path, calibration).name == "water.verification.json"
    until, doubts = describe_verification(path, calibration)
    assert not caplog.text, "its seal fits"
    assert doubts == [] and until.startswith(f"{datetime.now(UTC) + timedelta(days=1):%Y-%m-%d}")
    later = datetime.now(UTC) + timedelta(hours=30)
    assert "today's check is missing" in describe_verification(path, calibration, now=later)[1][0]
    # A clock that was set back.
    earlier = datetime.now(UTC) - timedelta(hours=30)
    assert "today's check is missing" in describe_verification(path, calibration, now=earlier)[1][0]
    other = calibration.model_copy(update={"sensor_name": "other"})
    assert "not verified since" in describe_verification(path, other)[1][0]


def test_a_failed_verification_is_told(dated):
    path, calibration = dated
    verified(path, calibration, measured_mm=50.2)
    until, doubts = describe_verification(path, calibration)
    assert until is None and "FAILED" in doubts[0] and "error +0.2000" in doubts[0]


def test_reconstruct_says_it(dated, tmp_path):
    path, calibration = dated
    capture = record(tmp_path / "scan.h5", stage=True)
    assert any("not verified since" in each for each in uwlts.reconstruct(capture, path).warnings)
    verified(path, calibration)
    cloud = uwlts.reconstruct(capture, path)
    assert not cloud.warnings and cloud.metadata["calibration_verified_until"].endswith("UTC")
    trajectory = uwlts.Trajectory(np.array([0.0, 4.0]), np.tile(np.eye(4), (2, 1, 1)))
    moved = uwlts.reconstruct(capture, path, trajectory=trajectory)
    assert any("does the platform stand still" in each for each in moved.warnings)
    assert "calibration_verified_until" in moved.metadata
    overridden = uwlts.reconstruct(capture, path, index=1.33)
    assert any("the verification does not apply: it had no `index`" in each for each in overridden.warnings)
    assert "calibration_verified_until" not in overridden.metadata
