"""Where each image was taken, and in which order the capture holds them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwlts.errors import DescriptionError
from uwlts.importing.description import ImportDescription
from uwlts.importing.matching import Matched, Row


@dataclass(frozen=True, eq=False)
class PlannedFrame:
    """A frame of the capture to be: image file, background file, and what is known of it; None where it is not."""

    path: Path
    laser_on: bool
    stage_mm: float
    exposure_ms: float | None
    time_s: float | None
    pose: np.ndarray | None
    background: Path | None


def planned_frames(folder: Path, told: ImportDescription, matched: Matched, *, in_table: bool) -> list[PlannedFrame]:
    """All frames in the order of the table, or of their positions, at each the lamp image before the laser image.

    Raises
    ------
    DescriptionError
        Positions are missing, given twice, or the same for two images of one light.
    """
    positions = _positions(told, matched)
    ordered = []
    for laser_on, rows in ((False, matched.lamp), (True, matched.laser)):
        exposure = told.exposure_ms if laser_on or told.lamp_exposure_ms is None else told.lamp_exposure_ms
        for place, row in enumerate(rows):
            frame = PlannedFrame(
                path=folder / row.file, laser_on=laser_on,
                stage_mm=_own(row) if positions is None else positions[place],
                exposure_ms=exposure if row.exposure_ms is None else row.exposure_ms, time_s=row.time_s, pose=row.pose,
                background=folder / matched.background[place] if laser_on and matched.background else None,
            )  # fmt: skip
            ordered.append((row.number if in_table else place, laser_on, frame))
    frames = [frame for *_, frame in sorted(ordered, key=lambda entry: entry[:2])]
    if not told.repeated:
        _refuse_repeated(frames)
    return frames


def stage_remark(told: ImportDescription) -> str:
    """How the positions are known, in words for the capture's provenance."""
    if told.stage.free:
        return "none: stage_mm counts the poses"
    if told.stage.start_mm is not None:
        return f"from {told.stage.start_mm:g} mm in steps of {told.stage.step_mm:g} mm"
    return "positions as listed"


def _positions(told: ImportDescription, matched: Matched) -> list[float] | None:
    """Position for each place in the natural order; None where the table tells them."""
    rows = [*matched.laser, *matched.lamp]
    stage, in_column = told.stage, any(row.stage_mm is not None for row in rows)
    elsewhere = stage.free or stage.start_mm is not None or stage.positions_mm is not None
    if in_column and elsewhere:
        raise DescriptionError("the table has a column stage_mm, and [stage] tells positions too: give one of them")
    if in_column:
        return None
    if not elsewhere:
        raise DescriptionError(
            "the positions of the stage are missing: give [stage] start_mm and step_mm, or positions_mm, or a table "
            "with a column stage_mm; or [stage] free = true if every image has a pose of its own"
        )
    counts = [len(rows) for rows in (matched.laser, matched.lamp) if rows]
    if len(set(counts)) > 1:
        raise DescriptionError(
            f"there are {counts[0]} laser and {counts[1]} lamp images: it is open which were taken at the same "
            "position; give a table with a column stage_mm"
        )
    count = counts[0]
    if stage.positions_mm is not None and len(stage.positions_mm) != count:
        raise DescriptionError(
            f"positions_mm has {len(stage.positions_mm)} positions for {count} images of a light: expected one for each"
        )
    if stage.positions_mm is not None:
        return list(stage.positions_mm)
    if stage.free:
        return [float(place) for place in range(count)]
    return [stage.start_mm + place * stage.step_mm for place in range(count)]


def _own(row: Row) -> float:
    if row.stage_mm is None:
        raise DescriptionError(f"the position of {row.file} is missing: fill in stage_mm in the table, or leave it out")
    return row.stage_mm


def _refuse_repeated(frames: list[PlannedFrame]) -> None:
    """Two images of one light at one place, as from a step of zero or a line copied in the table."""
    seen: dict[tuple[bool, float], PlannedFrame] = {}
    for frame in frames:
        if frame.pose is not None:
            continue
        other = seen.setdefault((frame.laser_on, frame.stage_mm), frame)
        if other is not frame:
            raise DescriptionError(
                f"{other.path.name} and {frame.path.name} have the same position, {frame.stage_mm:g} mm: correct it, "
                "or give repeated = true if several images were taken there"
            )
