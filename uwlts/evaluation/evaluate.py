"""Evaluation of point clouds against calibrated artefacts and ground truth, and evaluation files (JSON)."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, ValidationError, model_serializer

from uwlts.argument_types import check_arguments
from uwlts.errors import EvaluationError, describe_problems
from uwlts.evaluation.artefact_figures import evaluate_cloud
from uwlts.evaluation.figure_uncertainty import figure_uncertainties, shift_std_mm
from uwlts.evaluation.figures import (
    Count,
    Figure,
    FigureKey,
    FigureUncertainty,
    Quantity,
    StoredResult,
    TruthComparison,
    compare_with_truth,
    figure_keys,
)
from uwlts.files.json_files import EDITED, read_model, write_model
from uwlts.fitting.least_squares import fit_rigid_transform
from uwlts.model.artefacts import Artefact, resolve_artefact
from uwlts.model.sensor import Table
from uwlts.model.short_text import Brief
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import load_cloud
from uwlts.storage.number_tables import Unit
from uwlts.storage.truth import Truth, TruthHeader, read_truth, scene_digest, truth_path

TOLERANCE_MM = 0.010  # tolerance for points from perfect images and true parameters (tests/system/test_campaign.py)
MOST_STRANGE = 0.3
"""Largest fraction of points that do not belong to an artefact without a warning. Chosen by hand: above edges and
stands, and below one half, that of two scans in one."""
FORMAT = "uwlts-evaluation"
VERSION = 1  # of the file format


class ArtefactFigures(StoredResult):
    """Figures of an artefact by name, mm, the numbers of points, and results of the specific artefact.

    ``vdi_range_mm`` is the range of the deviations without 0.3 % of the points, as VDI/VDE 2634 allows.
    """

    kind: str
    figures_mm: dict[str, float]
    points_total: Count
    points_used: Count
    points_rejected: Count
    vdi_range_mm: float | None = None
    within_vdi_outliers: bool

    @property
    def strange_share(self) -> float:
        """Fraction of the cloud's points that do not belong to the artefact."""
        return 1 - (self.points_used + self.points_rejected) / max(self.points_total, 1)

    def doubts(self) -> list[str]:
        """Return a warning if many of the points do not belong to the artefact."""
        if self.strange_share <= MOST_STRANGE:
            return []
        return [
            f"{100 * self.strange_share:.0f} % of the points do not belong to the artefact ({self.kind}): remove other "
            "surfaces, or check whether all images are of one scan"
        ]


class Evaluation(Brief, StoredResult):
    """Result of `evaluate`, and content of its file.

    Attributes
    ----------
    source : str
        Name of the cloud.
    capture, sensor, medium : str or None
        Names of the cloud's capture, sensor and medium.
    medium_index : float or None
        Refractive index of the medium.
    artefact : Artefact or None
        Artefact with its calibrated values; None without an artefact.
    calibration : str or None
        Digest of the cloud's calibration.
    evaluation : ArtefactFigures or None
        Measurement of the artefact; None without an artefact.
    truth : TruthComparison or None
        Comparison of the points as measured, and after the best-fit rigid motion to the truth; None without a truth.
    uncertainty : dict of str to FigureUncertainty
        Uncertainties of the artefact's figures by name, if the cloud has them.
    edited : bool
        True if the file, or one that the cloud comes from, was edited by hand.
    cloud : PointCloud or None
        The evaluated cloud with the deviation of each point from the artefact's fit. Without an artefact, deviations
        are from the true surface after a best fit. None in an evaluation that was read from a file.
    """

    source: str = Field(alias="cloud")
    capture: str | None = None
    sensor: str | None = None
    medium: str | None = None
    medium_index: float | None = None
    artefact: Artefact | None = None
    calibration: str | None = None
    evaluation: ArtefactFigures | None = None
    truth: TruthComparison | None = None
    uncertainty: dict[str, FigureUncertainty] = {}
    edited: bool = False
    cloud: PointCloud | None = Field(default=None, alias="evaluated_cloud", exclude=True)

    @model_serializer(mode="wrap")
    def _omit_missing(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit missing keys, since clouds of other programs have no metadata."""
        given = self.model_fields_set - {"source"}
        return {"cloud": self.source} | {key: value for key, value in plain(self).items() if key in given}

    def figure_keys(self) -> dict[str, FigureKey]:
        """Return the keys of the artefact's figures by name; empty without an artefact."""
        return {} if self.artefact is None else {key.name: key for key in figure_keys(self.artefact)}

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Figures of the artefact, with uncertainties if the cloud has them."""
        values = {} if self.evaluation is None else self.evaluation.figures_mm
        keys = self.figure_keys().items()
        return tuple(Figure(key, values[name], self.uncertainty.get(name)) for name, key in keys if name in values)

    def all_of(self, quantity: Quantity) -> tuple[Figure, ...]:
        """Return all figures of a quantity; EvaluationError if there is none."""
        found = tuple(figure for figure in self.figures if figure.key.quantity is quantity)
        if not found:
            shown = "no artefact" if self.artefact is None else f"the artefact '{self.artefact.kind}'"
            raise EvaluationError(f"the evaluation of {shown} has no figure '{quantity}'")
        return found

    @property
    def sphere_spacings(self) -> tuple[Figure, ...]:
        """Spacings of consecutive spheres."""
        return self.all_of(Quantity.SPACING_ERROR)

    @property
    def sphere_spacing(self) -> Figure:
        """Sphere spacing with the largest error."""
        return max(self.sphere_spacings, key=lambda figure: abs(figure.value_mm))

    @property
    def diameters(self) -> tuple[Figure, ...]:
        """Diameters of the spheres or of the pipe."""
        return self.all_of(Quantity.DIAMETER_ERROR)

    @property
    def step_height(self) -> Figure:
        """Height of the step."""
        return self.all_of(Quantity.HEIGHT_ERROR)[0]

    @property
    def std(self) -> Figure:
        """Largest standard deviation about a fitted surface."""
        return self.all_of(Quantity.STD)[0]

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the evaluation as indented JSON, atomically; OutputError if writing fails."""
        write_model(path, self, file_format=FORMAT, version=VERSION, overwrite=overwrite)


def _compare_with_truth(cloud: PointCloud, truth: Truth) -> TruthComparison:
    """Compare a cloud with its ground truth, as it is and after the best-fit motion.

    A calibrated sensor's frame has its own origin and axes. After the best-fit motion, errors of form and size remain.
    """
    compared = compare_with_truth(cloud, truth, tolerance_mm=TOLERANCE_MM)
    measured, errors = cloud.points_mm[compared.is_matched], compared.error_mm[compared.is_matched]
    motion = fit_rigid_transform(measured, measured - errors)
    moved = cloud.points_mm @ motion[:3, :3].T + motion[:3, 3]
    stated = None if cloud.uncertainty is None else tuple((2 * shift_std_mm(cloud, compared.is_matched)).tolist())
    fitted = compare_with_truth(replace(cloud, points_mm=moved), truth, tolerance_mm=TOLERANCE_MM)
    shift = tuple(np.mean(errors, axis=0).tolist())
    return compared.model_copy(update={"after_best_fit": fitted, "shift_mm": shift, "shift_expanded_mm": stated})


def _name_other_scene(header: TruthHeader, path: Path, metadata: Table) -> str | None:
    """Return the difference between the scenes of a truth and a cloud, or None if no difference is known."""
    capture = metadata.get("capture")
    if (digest := metadata.get("scene")) is not None:
        found = scene_digest(header.scene)
        return None if found == digest else f"its scene has the digest {found}, the scene of {capture} has {digest}"
    stated, wanted = _read_kind(header.scene), _read_kind(metadata)
    if stated is not None and wanted is not None and stated != wanted:
        return f"it shows the artefact '{stated}', the cloud '{wanted}'"
    stated, wanted = header.scene.get("medium"), metadata.get("medium")
    if stated is not None and wanted is not None and stated != wanted:
        return f"its medium is {stated}, that of the cloud {wanted}"
    # Captures of earlier versions do not state their scene.
    if isinstance(capture, str) and path.name != (expected := truth_path(capture).name):
        return f"the cloud is of {capture}, which does not state its scene, and whose truth is named {expected}"
    return None


def _read_kind(described: Table) -> object:
    artefact = described.get("artefact")
    return artefact.get("kind") if isinstance(artefact, dict) else None


def evaluate(
    cloud: PointCloud | str | Path,
    artefact: Artefact | dict[str, object] | str | Path | None = None,
    truth: Truth | str | Path | None = None,
    *,
    source: str | None = None,
    unit: Unit | None = None,
) -> Evaluation:
    """Compare a cloud with its artefact's calibrated values, and point by point with ground truth.

    Parameters
    ----------
    cloud : PointCloud or path
        Point cloud (.ply or .h5) in the object coordinate system (OCS), mm.
    artefact : Artefact, dict or path of a TOML file, optional
        The artefact's kind and calibrated values; by default those in the capture.
    truth : Truth or path, optional
        Ground truth of a rendered capture.
    source : str, optional
        Name of the cloud in the evaluation file; by default the name of the cloud's file or capture.
    unit : {"mm", "m"}, optional
        As for `export`.

    Returns
    -------
    Evaluation
        Figures of the artefact with their uncertainties in mm, and statistics of the distances from the truth.

    Raises
    ------
    EvaluationError
        There is neither an artefact nor a truth, or an artefact's description is not valid. The cloud does not show
        the artefact. The truth is that of another capture.
    CaptureError, DescriptionError
        A file cannot be read.
    """
    if not isinstance(cloud, PointCloud):
        source = source or Path(cloud).name
    cloud = load_cloud(cloud, unit=unit)
    artefact = resolve_artefact(cloud.metadata.get("artefact") if artefact is None else artefact)
    if truth is not None and not isinstance(truth, Truth):
        header, read = read_truth(truth)
        if other := _name_other_scene(header, Path(truth), cloud.metadata):
            raise EvaluationError(
                f"{truth} is the truth of another capture: {other}; give the truth of the cloud's capture"
            )
        truth = read
    if artefact is None and truth is None:
        raise EvaluationError(
            "there is no reference for the evaluation: the capture names no artefact. Give `artefact` or `truth`"
        )
    compared = None if truth is None else _compare_with_truth(cloud, truth)
    found = None if artefact is None else evaluate_cloud(cloud, artefact)
    name = source or str(cloud.metadata.get("capture", ""))
    content: dict[str, Any] = {"cloud": name, **cloud.metadata, "artefact": None, "evaluation": None, "truth": compared}
    if EDITED in content:
        # The cloud names the part; the evaluation has a mark, which the seal protects.
        content[EDITED] = bool(content[EDITED])
    fitted = None if compared is None else compared.after_best_fit
    deviation = np.full(len(cloud), np.nan) if fitted is None else fitted.distance_mm
    if found is not None:
        deviation = found.deviation_mm
        content |= {"artefact": found.artefact, "evaluation": found.as_dict()}
        content["uncertainty"] = figure_uncertainties(cloud, found)
    try:
        return Evaluation.model_validate(content | {"evaluated_cloud": replace(cloud, deviation_mm=deviation)})
    except ValidationError as error:
        raise EvaluationError(f"the metadata of the cloud {name} is not valid: {describe_problems(error)}") from error


def read_evaluation(path: str | Path) -> Evaluation:
    """Read an evaluation file; CaptureError if it is missing, newer, damaged, or of another format."""
    advice = "; evaluate the cloud again"
    return read_model(path, Evaluation, file_format=FORMAT, version=VERSION, called="evaluation", advice=advice)
