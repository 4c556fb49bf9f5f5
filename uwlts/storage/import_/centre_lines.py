"""Files of centre lines of a 3D camera: tables (CSV), arrays (NPY), images (PNG, TIFF); one row per profile."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwlts.errors import DescriptionError, ImageError
from uwlts.files.reading import NPY_DAMAGE, read_bytes
from uwlts.model.sensor import Camera
from uwlts.model.stripe import ROWS, Coordinates
from uwlts.storage.image_file import read_image
from uwlts.storage.import_.folder_description import CentreLines
from uwlts.storage.import_.matching import ImageRow
from uwlts.storage.number_tables import read_number_table
from uwlts.storage.numbering import unwrap_counts

_MOST_BYTES = 2**28  # ten thousand profiles and more
_OF_PROFILES = ("stage_mm", "exposure_ms", "time_s", "encoder")


def read_profiles(path: Path, lines: int) -> np.ndarray:
    """Read K profiles of L lines as numbers (K, C, L) with the first C of `ROWS`; raises ImageError for other contents.

    A CSV file or an image has K rows of L numbers; in a CSV file, an empty cell or nan means no stripe. An array is
    (L,), (K, L) or (K, C, L).
    """
    match path.suffix.lower():
        case ".npy":
            content = read_bytes(path, most_bytes=_MOST_BYTES, error=ImageError, called="array")
            try:
                numbers = np.load(io.BytesIO(content), allow_pickle=False)
            except NPY_DAMAGE as error:
                raise ImageError(f"{path} is no NPY array, or is truncated: {error}") from error
            if not isinstance(numbers, np.ndarray) or numbers.dtype.kind not in "iuf":
                raise ImageError(f"{path} holds no numbers: expected an array of centre lines")
        case ".csv":
            try:
                numbers = np.column_stack([*read_number_table(path, named=False).columns.values()])
            except DescriptionError as error:
                raise ImageError(f"{error}; expected a row of {lines} numbers for each profile") from error
        case _:
            numbers = read_image(path)
            if numbers.ndim != 2:
                raise ImageError(f"{path} is a colour image; expected one number per profile line, in grey")
    numbers = np.atleast_2d(numbers)
    numbers = numbers[:, None] if numbers.ndim == 2 else numbers
    if numbers.ndim != 3 or numbers.shape[2] != lines or not 1 <= numbers.shape[1] <= len(ROWS):
        turned = "; it may be transposed: its first axis has the number of lines" if numbers.shape[0] == lines else ""
        raise ImageError(
            f"{path} has the shape {numbers.shape}; expected profiles in rows, with {lines} lines as the sensor "
            f"has{turned}"
        )
    return numbers


def profile_rows(
    rows: list[ImageRow], given: CentreLines, camera: Camera, *, folder: Path, repeated: bool = False
) -> list[ImageRow]:
    """Return one row for each profile in the laser files, in order, with stage positions from the encoder if given.

    ``repeated``: the stage may return.

    Raises ImageError if a file or centre line does not match the sensor's description, and DescriptionError if the
    table of profiles has another length or wrong columns.
    """
    meant = Coordinates(given.scale, given.offset, given.invalid)
    length = camera.height_px if camera.stripe_along == "width" else camera.width_px
    found = []
    for row in rows:
        for numbers in read_profiles(folder / row.file, camera.lines()):
            try:
                profile = meant.stripe(numbers, stripe_along=camera.stripe_along, length_px=length)
            except ImageError as error:
                raise ImageError(f"{row.file}: {error}") from error
            found.append(replace(row, profile=profile))
    if given.table is None:
        return found
    known = _read_table(folder / given.table)
    if len(known) != len(found):
        raise DescriptionError(f"{given.table} has {len(known)} rows, the laser files {len(found)} profiles")
    if given.mm_per_count is not None and known:
        if "encoder" not in known[0] or "stage_mm" in known[0]:
            raise DescriptionError(f"mm_per_count needs a column encoder in {given.table}, and no stage_mm")
        try:
            counts = unwrap_counts([values["encoder"] for values in known], given.encoder_bits, returns=repeated)
        except DescriptionError as error:
            raise DescriptionError(f"{given.table}: {error}") from error
        stages = (given.mm_per_count * counts).tolist()
        known = [values | {"stage_mm": stage} for values, stage in zip(known, stages, strict=True)]
    return [replace(row, **values) for row, values in zip(found, known, strict=True)]


def _read_table(path: Path) -> list[dict[str, float]]:
    table = read_number_table(path, named=False)
    if not (columns := table.columns).keys() <= set(_OF_PROFILES):
        raise DescriptionError(f"{path} has the columns {table.titles}; expected any of {', '.join(_OF_PROFILES)}")
    rows = np.column_stack([*columns.values()])
    if not np.isfinite(rows).all():
        raise DescriptionError(f"{path} has cells that are empty or not finite")
    return [dict(zip(columns, row, strict=True)) for row in rows.tolist()]
