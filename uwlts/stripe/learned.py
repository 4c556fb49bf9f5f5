"""Stripe centre found by a trained network, from a model file in ONNX format.

A model has one input, ``lines`` (B, P) float32: grey values of B profile lines divided by the full scale. The number of
pixels P is a multiple of `PIXELS_MULTIPLE`.

It has two outputs: ``centre_px`` (B,), the stripe's position on each line, and ``visible`` (B,), the probability of a
single stripe at this position. `docs/examples/learned_stripe` trains such a model.
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import DescriptionError, SetupError
from uwlts.files.reading import require_regular_file
from uwlts.model.stripe import StripeStatus

PIXELS_MULTIPLE = 16
"""Lengths of lines are padded to this multiple: four halvings, one more than a network of four levels needs."""

LEAST_VISIBLE = 0.5
"""Least probability of a line with a stripe."""

_LINES = 256
"""Lines in a batch, small enough for the processor's cache."""

_ABSENT = 0.05
"""Largest probability of a line without a stripe; from here to `LEAST_VISIBLE` it is ambiguous."""

_INPUTS = {"lines"}
_OUTPUTS = {"centre_px", "visible"}


def find_learned(profiles: np.ndarray, model: str | Path, *, clip: float) -> tuple[np.ndarray, np.ndarray]:
    """Return status (L,) uint8 and centre (L,) float64 on each of the profiles (N, L), from a model file.

    Centres are NaN unless the status is OK. Pixels at the grey value ``clip`` are saturated. DescriptionError if the
    file is not such a model; SetupError if ONNX Runtime is not installed.
    """
    session = _session(str(model), _stamp(Path(model)))
    count, lines = profiles.shape
    padded = -(-count // PIXELS_MULTIPLE) * PIXELS_MULTIPLE
    centre, visible = np.empty(lines), np.empty(lines)
    for first in range(0, lines, _LINES):
        part = profiles[:, first : first + _LINES].T.astype(np.float32) / np.float32(clip)
        part = np.pad(part, ((0, 0), (0, padded - count)), mode="edge")
        place, seen = session.run(["centre_px", "visible"], {"lines": np.ascontiguousarray(part)})
        if place.shape != (len(part),) or seen.shape != (len(part),):
            raise DescriptionError(
                f"{model} gives centre_px {place.shape} and visible {seen.shape} for {len(part)} lines; expected one "
                "value per line"
            )
        centre[first : first + _LINES], visible[first : first + _LINES] = place, seen
    status = np.where(visible < _ABSENT, StripeStatus.NO_STRIPE, StripeStatus.AMBIGUOUS).astype(np.uint8)
    inside = (centre >= 0) & (centre <= count - 1)
    status[visible >= LEAST_VISIBLE] = StripeStatus.OK
    status[(status == StripeStatus.OK) & ~inside] = StripeStatus.BORDER
    centre[status != StripeStatus.OK] = np.nan
    return status, centre


def _stamp(model: Path) -> tuple[int, int]:
    """Return time and size of a file, so that a retrained model is loaded again."""
    require_regular_file(model, called="model of the learned method")
    status = os.stat(model)
    return status.st_mtime_ns, status.st_size


@lru_cache(maxsize=2)
def _session(model: str, stamp: tuple[int, int]) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise SetupError(
            "the method learned needs ONNX Runtime, which is not installed: pip install 'uwlts[learn]'"
        ) from error
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise DescriptionError(f"{model} cannot be read as an ONNX model by ONNX Runtime: {error}") from error
    inputs, outputs = ({one.name for one in some} for some in (session.get_inputs(), session.get_outputs()))
    if inputs != _INPUTS or not outputs >= _OUTPUTS:
        raise DescriptionError(
            f"{model} has the inputs {sorted(inputs)} and outputs {sorted(outputs)}; expected the input "
            f"{sorted(_INPUTS)} and the outputs {sorted(_OUTPUTS)} (docs/examples/learned_stripe)"
        )
    return session
