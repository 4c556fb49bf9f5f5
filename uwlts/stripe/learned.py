"""The stripe's centre as a trained network sees it, from a model file in ONNX form.

A model has one input, ``lines`` (B, P) float32: grey values of B profile lines of P pixels, P a multiple of
`PIXELS_MULTIPLE`, as shares of the full scale. Its outputs are ``centre_px`` (B,), the place of the stripe on each
line, and ``visible`` (B,), the probability that there is one stripe, and there. `docs/examples/learned_stripe` trains
such a model.
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
"""Networks with four levels halve the line three times, and one more may."""

LEAST_VISIBLE = 0.5
"""Probability from which a line has a stripe."""

_LINES = 256
"""Lines given to the network at a time: its layers stay in the processor's cache."""

_ABSENT = 0.05
"""Probability below which nothing is there; between both a line is ambiguous."""

_INPUTS, _OUTPUTS = {"lines"}, {"centre_px", "visible"}


def find_learned(profiles: np.ndarray, model: str | Path, *, clip: float) -> tuple[np.ndarray, np.ndarray]:
    """Status (L,) uint8 and centre (L,) float64, NaN where not OK, on each of the profiles (N, L), by a model file.

    Pixels at the grey value ``clip`` are saturated. DescriptionError where the file is no such model; SetupError
    where ONNX Runtime is not installed.
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
                "value for each line"
            )
        centre[first : first + _LINES], visible[first : first + _LINES] = place, seen
    status = np.where(visible < _ABSENT, StripeStatus.NO_STRIPE, StripeStatus.AMBIGUOUS).astype(np.uint8)
    inside = (centre >= 0) & (centre <= count - 1)
    status[visible >= LEAST_VISIBLE] = StripeStatus.OK
    status[(status == StripeStatus.OK) & ~inside] = StripeStatus.BORDER
    centre[status != StripeStatus.OK] = np.nan
    return status, centre


def _stamp(model: Path) -> tuple[int, int]:
    """Time and size of a file, so that a model trained again is read again."""
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
        raise DescriptionError(f"{model} is no ONNX model that ONNX Runtime can read: {error}") from error
    inputs, outputs = ({one.name for one in some} for some in (session.get_inputs(), session.get_outputs()))
    if inputs != _INPUTS or not outputs >= _OUTPUTS:
        raise DescriptionError(
            f"{model} has the inputs {sorted(inputs)} and outputs {sorted(outputs)}; a model of stripes has the input "
            f"{sorted(_INPUTS)} and the outputs {sorted(_OUTPUTS)} (docs/examples/learned_stripe)"
        )
    return session
