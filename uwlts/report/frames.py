"""Results as tables of pandas. Columns are named after the attributes of the rows, whose names contain the units."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any, get_type_hints

import numpy as np
from pydantic import BaseModel

from uwlts.argument_types import union_members
from uwlts.errors import ArgumentError
from uwlts.evaluation.evaluate import Evaluation
from uwlts.inspection.features import Inspection
from uwlts.model.calibration import Calibration
from uwlts.model.short_text import Brief
from uwlts.report.certificate import parameter_rows
from uwlts.runtime.optional_library import optional_library
from uwlts.storage.cloud import NO_INDEX, PointCloud

if TYPE_CHECKING:
    from pandas import DataFrame

_KEY = "key"  # field that identifies a record; its own fields are columns without prefix


def to_frame(result: object) -> DataFrame:
    """Return a result as a table of pandas, an optional library.

    Rows are the figures of an `Evaluation`, the features' values of an `Inspection`, the parameters of a `Calibration`,
    the points of a `PointCloud`, and the designs of `twin.sweep`. A list of records has a row for each: a row of
    `design`, or an entry of ``Verification.verdicts`` or ``SurfaceChange.regions()``. Parameters have their standard
    uncertainties, in the units of pages. Points have the standard uncertainty of each
    coordinate, or that along the normal.

    Columns have the names of the attributes. A record within a record contributes its columns after its own name, and a
    vector three: ``centre_mm`` gives ``centre_x_mm`` to ``centre_z_mm``. Arrays of other sizes are left out.

    Parameters
    ----------
    result : Evaluation, Inspection, Calibration, PointCloud, SweepResult, list of records, or dict of columns
        The result.

    Returns
    -------
    pandas.DataFrame
        The table. Missing numbers are NaN, missing texts None.

    Raises
    ------
    ArgumentError
        The result has no table.
    SetupError
        Pandas is not installed.
    """
    table: Any
    match result:
        case PointCloud():
            table = _list_point_columns(result)
        case Evaluation():
            table = [_make_row(each) for each in result.figures]
        case Inspection():
            table = [
                {f"feature_{name}": value for name, value in _make_row(feature).items()} | _make_row(each)
                for feature in result.features
                for each in feature.values
            ]
        case Calibration():
            table = [_make_row(each) for each in parameter_rows(result)]
            if result.joint is None:
                text, std = "direction of the sheet's normal", result.std().sheet_normal_deg
                table.append({"name": "sheet_normal", "words": text, "unit": "°", "std": std})
        case Brief(columns=Mapping() as columns):
            table = columns
        case Mapping():
            table = result
        case Sequence() if all(_list_fields(type(each)) for each in result):
            table = [_make_row(each) for each in result]
        case _:
            raise ArgumentError(
                f"`result` is of the type {type(result).__name__}, which has no table; expected Evaluation, "
                "Inspection, Calibration, PointCloud, the result of a sweep, columns by name, or a list of records"
            )
    frame = optional_library("pandas", needed_by="a table of results", extra="frames").DataFrame
    try:
        return frame(table)
    except ValueError as error:
        raise ArgumentError(f"`result` is no set of columns of equal length: {error}") from error


def _list_point_columns(cloud: PointCloud) -> dict[str, np.ndarray]:
    """Return the known columns (N,) of a cloud."""
    columns = dict(zip(("x_mm", "y_mm", "z_mm"), cloud.points_mm.T, strict=True)) | {"intensity": cloud.intensity}
    for name in ("frame", "line"):
        if not ((known := getattr(cloud, name)) == NO_INDEX).all():
            columns[name] = known
    columns |= {name: getattr(cloud, name) for name in ("time_s", "deviation_mm", "random_std_mm", "common_std_mm")}
    if cloud.uncertainty is not None:
        columns |= dict(zip(_name_axes("std_mm"), cloud.uncertainty.std_mm().T, strict=True))
    return {name: values for name, values in columns.items() if values is not None}


def _make_row(record: object) -> dict[str, Any]:
    """Return the columns of a record: its fields, then its properties that are plain values."""
    row = _flatten(record, type(record))
    for name, member in vars(type(record)).items():
        if isinstance(member, property) and member.fget and _is_plain(value := getattr(record, name)):
            row[name] = _mark_missing(value, get_type_hints(member.fget)["return"])
    return row


def _flatten(record: object | None, kind: type) -> dict[str, Any]:
    """Return the plain fields of a record, None for those of a missing one."""
    row: dict[str, Any] = {}
    hints = get_type_hints(kind)
    for name in _list_fields(kind):
        value = getattr(record, name, None)
        inner = next((each for each in union_members(hints[name]) if dataclasses.is_dataclass(each)), None)
        if isinstance(inner, type):
            prefix = "" if name == _KEY else f"{name}_"
            row |= {f"{prefix}{within}": each for within, each in _flatten(value, inner).items()}
        elif name.endswith("_mm") and value is not None and np.shape(value) == (3,):
            row |= dict(zip(_name_axes(name), np.asarray(value).tolist(), strict=True))
        elif isinstance(value, Enum):
            row[name] = str(value)
        elif _is_plain(value) or (isinstance(value, tuple) and all(map(_is_plain, value))):
            row[name] = _mark_missing(value, hints[name])
    return row


def _list_fields(kind: Any) -> Sequence[str]:
    """Return the names of a record's fields; none for other types."""
    if dataclasses.is_dataclass(kind):
        return [field.name for field in dataclasses.fields(kind)]
    return list(kind.model_fields) if issubclass(kind, BaseModel) else getattr(kind, "_fields", ())


def _mark_missing(value: object, hint: object) -> object:
    """Return NaN for None in the place of a number, so that the column holds numbers."""
    return np.nan if value is None and float in union_members(hint) else value


def _name_axes(name: str) -> list[str]:
    """Return the names of a vector's columns, such as ``std_x_mm`` for ``std_mm``."""
    return [f"{name.removesuffix('_mm')}_{axis}_mm" for axis in "xyz"]


def _is_plain(value: object) -> bool:
    return value is None or isinstance(value, bool | int | float | str)
