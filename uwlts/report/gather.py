"""Reading of a campaign's folder, and of published values to compare with."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, FiniteFloat, Strict, TypeAdapter, ValidationError

from uwlts.errors import CaptureError, describe_problems
from uwlts.evaluation.evaluate import EvaluationRecord, read_evaluation
from uwlts.files.json_files import read_json
from uwlts.files.reading import is_regular_file
from uwlts.model.any_calibration import calibration_digest
from uwlts.model.calibration import Calibration
from uwlts.model.library import find_description, read_table, validate_description
from uwlts.model.sensor import Description, Sensor
from uwlts.storage.calibration_file import read_calibration
from uwlts.storage.capture import Capture, CaptureHeader
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import is_cloud, name_cloud, read_cloud
from uwlts.storage.truth import read_truth
from uwlts.storage.verification_file import ENDING as VERIFICATION

_EVALUATION, _TRUTH = ".evaluation.json", ".truth.h5"
_NOT_CALIBRATIONS = (_EVALUATION, ".certificate.json", VERIFICATION)

CALIBRATION = "calibration"
"""Name of the calibrations' values in a reference."""

_Number = Annotated[FiniteFloat, Strict()]
_SECONDS = TypeAdapter(dict[str, Annotated[_Number, Field(ge=0)]])


@dataclass(frozen=True, eq=False)
class GatheredCapture:
    """A capture of the campaign: header, number of images, and indices of those with the laser on."""

    path: Path
    header: CaptureHeader
    images: int
    laser_images: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the file without its suffix."""
        return self.path.stem


@dataclass(frozen=True, eq=False)
class GatheredCalibration:
    """A calibration of the campaign, with the digest stored in clouds."""

    name: str
    calibration: Calibration
    digest: str


@dataclass(frozen=True, eq=False)
class GatheredMeasurement:
    """A cloud with its evaluation, capture and calibration; missing parts are None, but never all of them."""

    name: str
    cloud: PointCloud | None
    judged: EvaluationRecord | None
    capture: GatheredCapture | None
    calibration: GatheredCalibration | None

    @property
    def digest(self) -> str | None:
        """Digest of the cloud's calibration, even if that calibration is not in the folder."""
        if self.judged is not None and self.judged.calibration is not None:
            return self.judged.calibration
        found = None if self.cloud is None else self.cloud.metadata.get("calibration")
        return found if isinstance(found, str) else None

    @property
    def known_as(self) -> tuple[str, ...]:
        """Names to look up published values: that of the measurement, then that of its capture."""
        return (self.name,) if self.capture is None else (self.name, self.capture.name)


@dataclass(frozen=True, eq=False)
class GatheredCampaign:
    """All files of a folder. ``true_sensors`` come from the truth files; ``seconds`` is the time of each stage."""

    folder: Path
    measurements: tuple[GatheredMeasurement, ...]
    calibrations: tuple[GatheredCalibration, ...]
    captures: tuple[GatheredCapture, ...]
    true_sensors: tuple[Sensor, ...]
    seconds: dict[str, float]

    @property
    def main_digest(self) -> str | None:
        """Digest of the calibration used by most clouds; if several are equally frequent, the first calibration's."""
        used = Counter(m.digest for m in self.measurements if m.digest is not None)
        return max([*(c.digest for c in self.calibrations), *used], key=used.__getitem__, default=None)

    @property
    def main_calibration(self) -> GatheredCalibration | None:
        """The calibration of `main_digest`; None if its file is not in the folder."""
        return next((c for c in self.calibrations if c.digest == self.main_digest), None)

    @property
    def main_measurements(self) -> tuple[GatheredMeasurement, ...]:
        """Measurements made with the main calibration, or with an unknown one."""
        return tuple(m for m in self.measurements if m.digest in (None, self.main_digest))

    @property
    def true_sensor(self) -> Sensor | None:
        """The true sensor with its windows; None without truth files, or if they disagree."""
        mounted = [sensor for sensor in self.true_sensors if sensor.camera.window.mounted]
        same = all((s.camera, s.laser) == (mounted[0].camera, mounted[0].laser) for s in mounted)
        return mounted[0] if mounted and same else None

    @property
    def true_window_mm(self) -> float | None:
        """Distance of the camera's window in the twin; None if `true_sensor` is None."""
        return None if self.true_sensor is None else self.true_sensor.camera.window.distance_mm


def gather_campaign(folder: str | Path) -> GatheredCampaign:
    """Read a campaign's folder.

    It contains captures ``NAME.h5``, their truth ``NAME.truth.h5``, clouds ``NAME.cloud.h5``, ``NAME.h5`` or
    ``NAME.ply``, evaluations ``NAME.evaluation.json``, calibrations ``calibration*.json``, and times ``seconds.json``.
    The metadata of a cloud name its capture; otherwise the capture of the same name is used. CaptureError if the folder
    is missing or contains nothing to report, or a file (named in the message) is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"there is no folder {folder}; give the folder of the campaign's files")
    in_hdf5 = list(_files(folder, "*.h5", but=_TRUTH))
    captures = {path.name: _capture(path) for path in in_hdf5 if not is_cloud(path)}
    read = {path.stem: read_calibration(path) for path in _files(folder, "calibration*.json", but=_NOT_CALIBRATIONS)}
    by_length = sorted(read, key=lambda name: (len(name), name))
    calibrations = [GatheredCalibration(name, read[name], calibration_digest(read[name])) for name in by_length]
    # Of a cloud in both formats, HDF5 is used.
    clouds = {name_cloud(path): read_cloud(path) for path in [*_files(folder, "*.ply"), *filter(is_cloud, in_hdf5)]}
    judged = {path.name.removesuffix(_EVALUATION): read_evaluation(path) for path in _files(folder, f"*{_EVALUATION}")}
    if not (clouds or judged or calibrations):
        raise CaptureError(
            f"{folder} holds {len(captures)} captures, but no cloud (.ply or .h5), evaluation ({_EVALUATION}) or "
            "calibration (calibration*.json): reconstruct and evaluate first"
        )
    by_digest = {calibration.digest: calibration for calibration in calibrations}
    measurements = []
    for name, cloud in sorted(_pair_clouds(clouds, judged).items()):
        recorded = None if cloud is None else cloud.metadata.get("capture")
        capture = captures.get(recorded) if isinstance(recorded, str) else None
        found = GatheredMeasurement(name, cloud, judged.get(name), capture or captures.get(f"{name}.h5"), None)
        measurements.append(replace(found, calibration=by_digest.get(found.digest or "")))
    return GatheredCampaign(
        folder=folder,
        measurements=tuple(measurements),
        calibrations=tuple(calibrations),
        captures=tuple(captures.values()),
        true_sensors=tuple(read_truth(path)[0].sensor for path in _files(folder, f"*{_TRUTH}")),
        seconds=_seconds(folder / "seconds.json"),
    )


def _files(folder: Path, pattern: str, *, but: str | tuple[str, ...] | None = None) -> Iterator[Path]:
    for path in sorted(folder.glob(pattern)):
        # Hidden files are still being written.
        if is_regular_file(path) and not path.name.startswith(".") and not (but and path.name.endswith(but)):
            yield path


def _capture(path: Path) -> GatheredCapture:
    with Capture(path) as capture:
        laser = tuple(np.flatnonzero(capture.laser_on).tolist())
        return GatheredCapture(path, capture.header, len(capture), laser)


def _pair_clouds(clouds: dict[str, PointCloud], judged: dict[str, EvaluationRecord]) -> dict[str, PointCloud | None]:
    """Pair clouds with evaluations by name; clouds without evaluation are included.

    An evaluation belongs to the cloud of its own name, or else to the cloud that it names. If that cloud has no
    deviations, it is replaced by its coloured copy, which the evaluation wrote.
    """
    pairs: dict[str, PointCloud | None] = {}
    taken = set()
    for name, found in judged.items():
        source = name if name in clouds else name_cloud(found.cloud)
        pairs[name] = plain = clouds.get(source)
        taken.add(source)
        if plain is not None and plain.deviation_mm is None:
            for copy, cloud in clouds.items():
                same = np.array_equal(cloud.points_mm, plain.points_mm)
                if same and cloud.deviation_mm is not None and copy not in judged:
                    pairs[name] = cloud
                    taken.add(copy)
    return pairs | {name: cloud for name, cloud in clouds.items() if name not in taken and name not in judged}


def _seconds(path: Path) -> dict[str, float]:
    try:
        return _SECONDS.validate_python(read_json(path, called="table of times")) if is_regular_file(path) else {}
    except CaptureError as error:
        raise CaptureError(f"{error}; expected the seconds of each stage by name") from error
    except ValidationError as error:
        expected = 'the seconds of each stage by name: {"render": 12.3, ...}'
        raise CaptureError(f"{path} must hold {expected}; {describe_problems(error)}") from error


def _several(value: object) -> tuple[object, ...]:
    return tuple(value) if isinstance(value, list) else (value,)


class Reference(Description):
    """Published values in mm by measurement and figure, one or several each."""

    title: str
    figures: dict[str, dict[str, Annotated[tuple[_Number, ...], BeforeValidator(_several)]]]

    def values(self, measurements: tuple[str, ...], figure: str) -> tuple[float, ...]:
        """Return values of a figure for the first of the measurement names that has any; empty if none has."""
        return next((v for name in measurements if (v := self.figures.get(name, {}).get(figure))), ())


def load_reference(name_or_path: str | Path) -> Reference:
    """Read published values by name (``thesis``) or path of a TOML file.

    DescriptionError if the name is unknown, or the file contains anything but numbers by measurement and figure.
    """
    path = find_description(name_or_path, "references")
    table = read_table(path, "references")
    return validate_description(Reference, {"title": table.pop("title", path.stem), "figures": table}, path)
