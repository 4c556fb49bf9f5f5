"""Description of a folder of images: a TOML file with sensor, medium, the role of each image, and the stage."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from uwlts.errors import DescriptionError
from uwlts.files.reading import MOST_JSON_BYTES, is_regular_file, parse_json, read_text
from uwlts.model.artefacts import parse_artefact
from uwlts.model.library import (
    Level,
    find_description,
    load_sensor,
    merge_tables,
    read_levels,
    read_table,
    validate_description,
    validate_sensor,
)
from uwlts.model.sensor import Description, NotNegative, Sensor, Table, Vector
from uwlts.storage.capture import NO_STAGE, CaptureHeader
from uwlts.storage.import_.camera_files import read_intrinsics, set_intrinsics
from uwlts.storage.import_.grey_values import BayerPattern, Channel, is_formula
from uwlts.targets import parse_target

NAME = "import.toml"
"""Name of the description in the folder of the images, unless another path is given."""

Patterns = str | tuple[str, ...]

_OF_THE_HEADER = ("name", "sensor", "intrinsics", "medium", "saturation_dn", "target", "artefact")
_OF_THE_HEADER += ("provenance", "bits", "aligned")


class StageMotion(Description):
    """Positions of the stage: by start and step, by a list, or none if every image has its own pose (free).

    ``direction`` is the sensor's motion for growing positions, a unit vector in the OCS.
    """

    start_mm: float | None = None
    step_mm: float | None = None
    positions_mm: tuple[float, ...] | None = None
    free: bool = False
    direction: Vector | None = None

    @model_validator(mode="after")
    def _check_exclusive(self) -> "StageMotion":
        if (self.start_mm is None) != (self.step_mm is None):
            raise ValueError("start_mm and step_mm belong together: give both, or positions_mm")
        given = [self.start_mm is not None, self.positions_mm is not None, self.free]
        if sum(given) > 1:
            raise ValueError("give the positions once: start_mm and step_mm, or positions_mm, or free = true")
        return self


class ImportDescription(Description):
    """Description of a folder of images.

    ``header`` names a capture's header as JSON, which replaces all fields that it contains. Other files are relative to
    the description, images to their folder. ``sensor`` is a name, the path of a description, or a table with an
    optional ``base``. ``laser``, ``lamp``, ``background`` and ``ignore`` are patterns of file names; images that are
    both ``laser`` and ``lamp`` show the laser on the lit target. ``bayer`` is the pattern of a colour camera's raw
    images. ``table`` is a CSV file with the values of each image.
    """

    header: str | None = None
    name: str | None = None
    sensor: str | Table | None = None
    intrinsics: str | None = None
    medium: str | None = None
    laser: Patterns = ()
    lamp: Patterns = ()
    background: Patterns = ()
    ignore: Patterns = ()
    table: str | None = None
    channel: Channel | None = None
    lamp_channel: Channel | None = None
    bayer: BayerPattern | None = None
    bits: Annotated[int, Field(ge=8, le=16)] | None = None
    aligned: Literal["low", "high"] = "low"
    saturation_dn: Annotated[int, Field(gt=0)] | None = None
    exposure_ms: NotNegative | None = None
    lamp_exposure_ms: NotNegative | None = None
    repeated: bool = False
    stage: StageMotion = StageMotion()
    target: Table | None = None
    artefact: Table | None = None
    provenance: Table | None = None

    @model_validator(mode="after")
    def _check_given_once(self) -> "ImportDescription":
        missing = [name for name in ("sensor", "medium") if getattr(self, name) is None]
        if self.header is None and missing:
            raise ValueError(f"{' and '.join(missing)} missing: a capture states its sensor and its medium")
        twice = [name for name in _OF_THE_HEADER if name in self.model_fields_set]
        twice += ["stage.direction"] if self.stage.direction is not None else []
        if self.header is not None and twice:
            raise ValueError(f"the header gives {', '.join(twice)} already: leave out one of the two")
        return self

    def channel_of_lamp(self, image: np.ndarray) -> str | None:
        """Return the channel of lamp images such as ``image``; by default grey if that of the laser is a formula."""
        if self.lamp_channel is not None:
            return self.lamp_channel
        return "grey" if is_formula(self.channel, image) and image.ndim == 3 else self.channel


def read_description(path: Path) -> ImportDescription:
    """Read a TOML file; raises DescriptionError if it is missing, not TOML, or has an unknown or wrong key."""
    if not is_regular_file(path):
        raise DescriptionError(
            f"no description at {path}: write one with sensor, medium, and the role of each image "
            "(docs/reference/import-description.md)"
        )
    return validate_description(ImportDescription, read_table(path), path)


def capture_header(
    given: ImportDescription, sensor: Sensor, *, beside: Path, name: str, saturation_dn: int, remarks: Table
) -> CaptureHeader:
    """Return the header of an imported capture.

    ``beside`` is the folder of the files that the description names; ``name`` and ``remarks`` are used if it has none.

    Raises DescriptionError if medium, target, direction or header are missing, unknown or not valid; EvaluationError if
    the artefact is not valid.
    """
    # A description with its own provenance must not hide that there is no stage.
    mark: Table = {"stage": NO_STAGE} if given.stage.free else {}
    if given.header is not None:
        header = read_header(beside / given.header)
        return header.model_copy(update={"provenance": header.provenance | mark})
    if given.stage.direction is None and not given.stage.free:
        raise DescriptionError(
            "stage.direction is missing: give the unit vector in which the stage moves the sensor, in the OCS, "
            "such as [1, 0, 0] across the sheet, or stage.free = true for images without a stage"
        )
    if given.target is not None:
        parse_target(given.target)
    if given.artefact is not None:
        parse_artefact(given.artefact)
    table = {"name": given.name or name, "sensor": sensor, "saturation_dn": saturation_dn}
    table |= {"stage_direction": given.stage.direction or (1.0, 0.0, 0.0), "medium_name": given.medium}
    table |= {"medium": sensor.medium(given.medium or ""), "target": given.target, "artefact": given.artefact}
    table |= {"provenance": (remarks if given.provenance is None else given.provenance) | mark}
    return validate_description(CaptureHeader, table, "the header from the description")


def read_header(path: Path) -> CaptureHeader:
    """Read a capture's header from JSON; raises DescriptionError if it is missing, not JSON or not valid."""
    text = read_text(path, most_bytes=MOST_JSON_BYTES, error=DescriptionError, called="header in JSON")
    try:
        content = parse_json(text)
    except ValueError as error:
        raise DescriptionError(f"{path} is no header in JSON, or is truncated: {error}") from error
    return validate_description(CaptureHeader, content, path)


def described_sensor(given: ImportDescription, *, beside: Path) -> Sensor:
    """Return the sensor that took the images, with the intrinsics of another program's calibration if given."""
    if given.header is not None:
        return read_header(beside / given.header).sensor
    if isinstance(given.sensor, dict):
        table = {key: value for key, value in given.sensor.items() if key != "base"}
        if (base := given.sensor.get("base")) is not None:
            bases = read_levels(find_description(_resolve_beside(beside, base), "sensors"), "sensors")
            sensor = validate_sensor((*bases, Level("sensor", table, merge_tables(bases[-1].merged, table))), "sensor")
        else:
            sensor = validate_description(Sensor, table, "sensor")
    else:
        sensor = load_sensor(_resolve_beside(beside, given.sensor))
    if given.intrinsics is None:
        return sensor
    return set_intrinsics(sensor, read_intrinsics(beside / given.intrinsics), source=given.intrinsics)


def _resolve_beside(folder: Path, name: object) -> str:
    """Return a sensor's name unchanged, or the path of a description relative to the one that names it."""
    if not isinstance(name, str):
        raise DescriptionError(f"sensor is based on {name!r}; expected the name or path of a description")
    return str(folder / name) if name.endswith(".toml") else name
