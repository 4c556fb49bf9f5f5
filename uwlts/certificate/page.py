"""The certificate as a page to read and to print, and its files."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from uwlts.calibration.joint.volume import regions
from uwlts.calibration.model import Calibration
from uwlts.calibration.sources import captures_in
from uwlts.certificate.changes import change_from, require_same_sensor
from uwlts.certificate.content import parameter_rows
from uwlts.certificate.form import form_of
from uwlts.certificate.lengths import Worth, in_use
from uwlts.certificate.pictures import correlation_picture, heat_map, image_residuals, length_chart
from uwlts.errors import OutputError
from uwlts.files import refuse_unsuitable, written_aside
from uwlts.report.numbers import fixed
from uwlts.report.page_toolkit import MISSING, render_page

_WORST_IMAGES = 5


def json_beside(page: Path) -> Path:
    """Where the JSON of a certificate's page goes."""
    return page.with_suffix(".json")


def refuse_unsuitable_page(page: Path, source: Path, *, overwrite: bool) -> None:
    """OutputError where a certificate cannot be written, or would replace the calibration that it is about."""
    if json_beside(page).resolve() == source.resolve() or page.resolve() == source.resolve():
        raise OutputError(f"the certificate's JSON beside {page} would replace the calibration; give another name")
    if page.suffix == ".json":
        raise OutputError(f"{page} is the page, which is HTML, and its JSON goes beside it; give a name like cert.html")
    for path in (page, json_beside(page)):
        refuse_unsuitable(path, overwrite=overwrite)


def write_certificate(
    page: str | Path, content: dict[str, Any], calibration: Calibration, *,
    before: tuple[str, Calibration] | None = None, overwrite: bool = False,
) -> None:  # fmt: skip
    """Write a certificate's page, and its JSON beside it, each whole or not at all.

    Raises
    ------
    OutputError
        One of them exists and ``overwrite`` is not given, or cannot be written.
    CalibrationError
        As `certificate_page`.
    """
    text = certificate_page(content, calibration, before=before)
    with (
        written_aside(json_beside(Path(page)), overwrite=overwrite) as beside,
        written_aside(page, overwrite=overwrite) as aside,
    ):
        beside.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        aside.write_text(text, encoding="utf-8")


def certificate_page(
    content: dict[str, Any], calibration: Calibration, *, before: tuple[str, Calibration] | None = None
) -> str:
    """The page as text; ``before`` is another calibration of the sensor with its name, set beside this one.

    Raises
    ------
    CalibrationError
        The joint estimate is damaged, or the other calibration is of another sensor.
    """
    if before is not None:
        require_same_sensor(calibration, before[1])
    return render_page(
        "uwlts.certificate",
        "template.html.j2",
        c=content,
        captures=captures_in(content["made_from"]),
        warnings=content["made_from"].get("warnings", []),
        known_before=content["made_from"].get("known_before", {}),
        parameters=_parameters(content["parameters"], before),
        before=None if before is None else before[0],
        lengths=_length_rows(content.get("lengths", [])),
        **_pictures(content, calibration, before),
    )  # fmt: skip


def _pictures(
    content: dict[str, Any], calibration: Calibration, before: tuple[str, Calibration] | None
) -> dict[str, Any]:
    drawn: dict[str, Any] = {"maps": [], "changes": [], "largest_change_um": None, "worst": []}
    joint = calibration.joint
    if joint is None:
        return drawn
    drawn["correlation"] = Markup(correlation_picture(joint.parameters, joint.covariance_matrix()))
    if content["images"]:
        drawn["residuals"] = [Markup(picture) for picture in image_residuals(content["images"])]
        drawn["worst"] = sorted(
            (image for image in content["images"] if image["rms_px"] is not None),
            key=lambda image: -image["rms_px"] / content["scatter_px"][image["kind"]],
        )[:_WORST_IMAGES]  # fmt: skip
    if "lengths" not in content:
        return drawn
    region = regions(calibration)[0]
    form = form_of(in_use(calibration, region))
    drawn["chart"] = Markup(length_chart([Worth(**row) for row in content["lengths"]]))
    for what, values in (("calibration", form.calibration_mm), ("single point", form.point_mm)):
        drawn["maps"] += [
            Markup(heat_map(f"u({axis}), {what}", form.at_mm, 1e3 * values[..., place]))
            for place, axis in ((1, "Y"), (2, "Z"), (0, "X"))
        ]
    drawn["maps"] += [
        Markup(heat_map(f"u of {form.short_mm:g} mm along {axis}", form.at_mm, 1e3 * values))
        for axis, values in (("Y", form.along_y_mm), ("Z", form.along_z_mm))
    ]
    if before is not None:
        change = change_from(calibration, before[1], region)
        drawn["largest_change_um"] = 1e3 * change.largest_mm
        drawn["changes"] = [
            Markup(heat_map(f"change in {axis}", change.at_mm, 1e3 * change.moved_mm[..., place], signed=True))
            for place, axis in ((1, "Y"), (2, "Z"), (0, "X"))
        ]
    return drawn


def _parameters(
    rows: Sequence[dict[str, Any]], before: tuple[str, Calibration] | None
) -> list[tuple[str, str, str, str, str, str, str]]:
    """Words, unit, value, standard uncertainty, that before; value and uncertainty by the other calibration."""
    other = {} if before is None else {row["name"]: row for row in parameter_rows(before[1])}
    shown = []
    for row in rows:
        beside = other.get(row["name"])
        shown.append((row["words"], row["unit"], *_with_std(row), _number(row["std_before"]), *_with_std(beside)))
    mine = {row["name"] for row in rows}
    shown += [
        (row["words"], row["unit"], MISSING, MISSING, MISSING, *_with_std(row))
        for name, row in other.items() if name not in mine
    ]  # fmt: skip
    return shown


def _with_std(row: dict[str, Any] | None) -> tuple[str, str]:
    """A value with as many decimals as two digits of its uncertainty have, and that."""
    if row is None:
        return MISSING, MISSING
    if row["std"] is None or not row["std"] > 0:
        return f"{row['value']:.6g}", MISSING
    decimals = max(0, 1 - math.floor(math.log10(row["std"])))
    return fixed(row["value"], decimals), fixed(row["std"], decimals)


def _number(value: float | None) -> str:
    return MISSING if value is None else fixed(value, max(0, 1 - math.floor(math.log10(value))))


def _length_rows(lengths: Sequence[dict[str, Any]]) -> list[tuple[float, list[tuple[str, str]]]]:
    """Length, and for X, Y and Z its expanded uncertainties in µm; a dash where it does not fit."""
    table = {(row["length_mm"], row["axis"]): row for row in lengths}
    rows = []
    for length in dict.fromkeys(sorted(row["length_mm"] for row in lengths)):
        found = [table.get((length, axis)) for axis in "XYZ"]
        rows.append((length, [(MISSING, MISSING) if row is None else
                              (fixed(1e3 * row["calibration_mm"], 1), fixed(1e3 * row["point_mm"], 1))
                              for row in found]))  # fmt: skip
    return rows
