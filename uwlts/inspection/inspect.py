"""Inspection of a cloud by kind of object."""

import inspect
import os
from collections.abc import Callable
from typing import Literal

from uwlts.errors import EvaluationError
from uwlts.inspection.features import Inspection
from uwlts.inspection.pipe import inspect_pipe
from uwlts.inspection.weld import inspect_weld
from uwlts.storage.cloud import PointCloud

InspectionKind = Literal["pipe", "weld"]
INSPECTIONS: dict[InspectionKind, Callable[..., Inspection]] = {"pipe": inspect_pipe, "weld": inspect_weld}


def inspect_cloud(cloud: PointCloud | str | os.PathLike[str], kind: InspectionKind, **options: object) -> Inspection:
    """Inspect a cloud as a kind of object; EvaluationError for an option that this kind does not have."""
    function = INSPECTIONS[kind]
    if foreign := [f"`{name}`" for name in options if name not in inspect.signature(function).parameters]:
        raise EvaluationError(f"the inspection of a {kind} does not take {', '.join(foreign)}: remove the option")
    return function(cloud, **options)
