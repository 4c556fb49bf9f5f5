"""Scale errors by direction from the errors of measured lengths: the shares of stage and sensor."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.stats import t as t_distribution

from uwlts.acceptance.characteristics import CharacteristicValue, StoredPart
from uwlts.model.sensor import Vector

Component = Literal["XX", "YY", "ZZ", "YZ", "XY", "XZ"]
Share = Literal["stage", "sensor", "stage or sensor"]

_AXES: dict[Component, tuple[int, int]] = {
    "XX": (0, 0),
    "YY": (1, 1),
    "ZZ": (2, 2),
    "YZ": (1, 2),
    "XY": (0, 1),
    "XZ": (0, 2),
}
_SHARES: dict[Component, Share] = {
    "XX": "stage",
    "YY": "sensor",
    "ZZ": "sensor",
    "YZ": "sensor",
    "XY": "stage or sensor",
    "XZ": "stage or sensor",
}
_WORDS: dict[Component, str] = {
    "XX": "scale along X, the stage's axis",
    "YY": "scale along Y, the stripe",
    "ZZ": "scale along Z, the laser's axis",
    "YZ": "shear of Y and Z, within the sheet",
    "XY": "shear of X and Y: direction of the stage, or tilt of the sheet",
    "XZ": "shear of X and Z: direction of the stage, or tilt of the sheet",
}
_RANK = 1e-3
"""Smallest singular value relative to the largest, for directions of lengths that differ."""
_ACROSS = 0.1
"""Largest component of the stage's direction along the sheet at which lengths along X are those of the stage."""


class ScaleComponent(StoredPart):
    """Scale or shear of the measured lengths, and whose share it is.

    ``value`` is relative: 1e-4 is 0.01 mm per 100 mm. ``std`` is the standard error by the scatter of the lengths and
    the calibration of the artefacts, and ``half_interval`` half of the 95 % interval. All are None if the positions do
    not determine the component.
    """

    component: Component
    words: str
    share: Share
    value: float | None = None
    std: float | None = None
    half_interval: float | None = None

    @property
    def significant(self) -> bool:
        """True if the 95 % interval excludes zero."""
        return self.value is not None and self.half_interval is not None and abs(self.value) > self.half_interval


class DirectionalScale(StoredPart):
    """Regression of length errors on their directions.

    Attributes
    ----------
    components : tuple of ScaleComponent
        Scales along the axes, then shears.
    anisotropy : ScaleComponent or None
        Scale along the stage minus the mean scale across it: the calibration of a single artefact cancels.
    lengths, degrees : int
        Number of lengths, and degrees of freedom of the scatter.
    scatter_mm : float or None
        Standard deviation of the length errors that the components leave; None without degrees of freedom.
    remarks : tuple of str
        What the lengths cannot separate.
    """

    components: tuple[ScaleComponent, ...]
    anisotropy: ScaleComponent | None
    lengths: int
    degrees: int
    scatter_mm: float | None
    remarks: tuple[str, ...]


def fit_directional_scale(
    values: Sequence[CharacteristicValue], artefacts: Sequence[str], stage_directions: Sequence[Vector]
) -> DirectionalScale | None:
    """Return scales and shears from measured lengths; None without lengths.

    The error of a length L along the unit vector d is L dᵀ E d with a symmetric E (3, 3), plus scatter (least squares).
    The stage moves points along its direction by their distance from the sheet, whose normal is X. An error of the
    stage's scale therefore changes only the component XX, and an error of its direction only XY and XZ. A wrong tilt of
    the sheet changes XY and XZ, too. All other components are those of the sensor.

    Each value comes with its artefact, whose calibration error is common to its lengths, and its stage direction.
    """
    rows = [
        (value, name, stage)
        for value, name, stage in zip(values, artefacts, stage_directions, strict=True)
        if value.length_mm is not None and value.direction is not None
    ]
    if not rows:
        return None
    along = np.array([value.direction for value, _, _ in rows])
    lengths = np.array([value.length_mm or 0.0 for value, _, _ in rows])
    errors = np.array([value.value_mm for value, _, _ in rows])
    design = lengths[:, None] * np.column_stack(
        [(1 if i == j else 2) * along[:, i] * along[:, j] for i, j in _AXES.values()]
    )
    left, sizes, right = np.linalg.svd(design, full_matrices=False)
    used = sizes > _RANK * sizes[0]
    inverse = (right[used].T / sizes[used]) @ left[:, used].T
    solved = inverse @ errors
    degrees = len(rows) - int(np.count_nonzero(used))
    residuals = errors - design @ solved
    scatter = float(np.sqrt(residuals @ residuals / degrees)) if degrees else None
    groups = sorted({name for _, name, _ in rows})
    common = np.array(
        [[(value.calibration_std_mm or 0.0) * (name == group) for group in groups] for value, name, _ in rows]
    )
    moved = inverse @ common
    # A component is determined if the directions' null space does not contain a part of it.
    determined = np.linalg.norm(right[used], axis=0) > 1 - 1e-6

    def component(weights: np.ndarray, name: Component, words: str, share: Share) -> ScaleComponent:
        if not determined[weights != 0].all():
            return ScaleComponent(component=name, words=words, share=share)
        value = float(weights @ solved)
        if scatter is None:
            return ScaleComponent(component=name, words=words, share=share, value=value)
        by_scatter = scatter * float(np.linalg.norm(weights @ inverse))
        by_calibration = float(np.linalg.norm(weights @ moved))
        half = float(np.hypot(t_distribution.ppf(0.975, degrees) * by_scatter, 2 * by_calibration))
        std = float(np.hypot(by_scatter, by_calibration))
        return ScaleComponent(component=name, words=words, share=share, value=value, std=std, half_interval=half)

    aligned = all(np.hypot(stage[1], stage[2]) <= _ACROSS for _, _, stage in rows)
    shares: dict[Component, Share] = _SHARES if aligned else dict.fromkeys(_SHARES, "stage or sensor")
    components = tuple(
        component(np.eye(6)[place], name, _WORDS[name], shares[name]) for place, name in enumerate(_AXES)
    )
    across = component(
        np.array([1.0, -0.5, -0.5, 0, 0, 0]), "XX", "scale along X minus the mean of those along Y and Z", shares["XX"]
    )
    return DirectionalScale(
        components=components,
        anisotropy=across if across.value is not None else None,
        lengths=len(rows),
        degrees=degrees,
        scatter_mm=scatter,
        remarks=tuple(_remarks(components, degrees, aligned=aligned, artefacts=len(groups))),
    )


def _remarks(components: Sequence[ScaleComponent], degrees: int, *, aligned: bool, artefacts: int) -> list[str]:
    remarks = []
    if not aligned:
        remarks.append(
            "the stage moves along the sheet, not across it: no direction of a length belongs to the stage or the "
            "sensor alone"
        )
    else:
        remarks.append(
            "a wrong direction of the stage and a wrong tilt of the sheet have the same effect (shears XY and XZ): "
            "lengths cannot separate them"
        )
    if missing := [each.component for each in components if each.value is None]:
        remarks.append(
            f"the directions of the lengths do not determine {', '.join(missing)}: measure lengths in other directions"
        )
    if not degrees:
        remarks.append("there are no more lengths than components: their standard errors are not known")
    if artefacts == 1:
        remarks.append(
            "all lengths are of one artefact: a common scale of all axes cannot be separated from its calibration "
            "beyond the certificate's uncertainty, differences between axes can"
        )
    remarks.append(
        "the scatter contains noise, position errors of the stage within a scan and errors of the sensor that vary "
        "over the volume: their shares are not known"
    )
    return remarks
