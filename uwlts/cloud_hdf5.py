"""The arrays of a cloud as an HDF5 file: compressed, with checksums, labelled as all HDF5 files of the program."""

import os
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from uwlts.errors import CaptureError
from uwlts.file_label import read_label, write_label
from uwlts.files import written_aside
from uwlts.sensor import Description

FORMAT = "uwlts-cloud"
VERSION = 1


class CloudHeader(Description):
    """What holds for a whole cloud: its metadata."""

    metadata: dict[str, Any]


def write_arrays(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], metadata: dict[str, Any], *, overwrite: bool
) -> None:
    """Write named arrays with their metadata, whole or not at all; OutputError where that fails."""
    # In memory first: HDF5 does not survive a full disk.
    content = BytesIO()
    with h5py.File(content, "w", libver="latest") as file:
        write_label(file, format=FORMAT, version=VERSION, header=CloudHeader(metadata=metadata))
        for name, values in arrays.items():
            file.create_dataset(
                name, data=values, compression="gzip", compression_opts=1, shuffle=True, fletcher32=True
            )
    with written_aside(path, overwrite=overwrite) as aside:
        aside.write_bytes(content.getbuffer())


def read_arrays(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Named arrays of numbers and the metadata.

    Raises
    ------
    CaptureError
        The file is missing, no cloud, newer or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError(f"{path} does not exist" if not path.exists() else f"{path} is no file")
    try:
        with h5py.File(path, "r") as file:
            header = read_label(file, CloudHeader, path=path, format=FORMAT, version=VERSION)
            arrays = {name: np.asarray(dataset[...]) for name, dataset in file.items()}
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise CaptureError(f"{path} is not a complete HDF5 file of a cloud: {error}") from error
    unusable = [name for name, values in arrays.items() if values.dtype.kind not in "iuf"]
    if unusable:
        raise CaptureError(f"{path} is damaged: {', '.join(unusable)} are no numbers")
    return arrays, header.metadata
