"""Stripe centre found by a trained network, from a model file in ONNX format.

A model has one input, ``lines`` (B, P) float32: grey values of B profile lines divided by the full scale. The number of
pixels P is a multiple of `PIXELS_MULTIPLE`.

It has two outputs: ``centre_px`` (B,), the stripe's position on each line, and ``visible`` (B,), the probability of a
single stripe at this position. `docs/examples/learned_stripe` trains such a model.
"""

from __future__ import annotations

import os
import subprocess
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import DescriptionError
from uwlts.files.reading import read_bytes, require_regular_file, shorten
from uwlts.model.stripe import StripeStatus
from uwlts.runtime.optional_library import optional_library

PIXELS_MULTIPLE = 16
"""Lengths of lines are padded to this multiple: four halvings, one more than a network of four levels needs."""

LEAST_VISIBLE = 0.5
"""Least probability of a line with a stripe."""

_LINES = 256
"""Lines in a batch, small enough for the processor's cache."""

_ABSENT = 0.05
"""Largest probability of a line without a stripe; from here to `LEAST_VISIBLE` it is ambiguous."""

_CALLED = "model of the learned method"
_MOST_BYTES = 256 * 2**20  # a hundred times the usual model
_OPERATORS = (
    "Abs Add And ArgMax ArgMin AveragePool BatchNormalization Cast Ceil Clip Concat Constant Conv ConvTranspose Cos "
    "DepthToSpace Div Dropout Einsum Elu Equal Erf Exp Expand Flatten Floor Gather GatherElements Gelu Gemm "
    "GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual GroupNormalization HardSigmoid HardSwish Identity "
    "InstanceNormalization LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max MaxPool Mean Min "
    "Mish Mul Neg Not Or PRelu Pad Pow Range ReduceL1 ReduceL2 ReduceLogSumExp ReduceMax ReduceMean ReduceMin "
    "ReduceProd ReduceSum ReduceSumSquare Reciprocal Relu Reshape Resize Round Selu Shape Sigmoid Sign Sin Slice "
    "Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tanh ThresholdedRelu TopK Transpose Trilu "
    "Unsqueeze Where"
)
"""Operators of networks without loops, branches and subgraphs (ONNX, operator set "ai.onnx")."""
_TRIAL = """
import sys
import numpy, onnxruntime
if sys.platform == "linux":
    import resource
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    hard = [each for each in (resource.getrlimit(resource.RLIMIT_AS)[1],) if each != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min([used + int(sys.argv[4]), *hard]),) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (int(sys.argv[5]),) * 2)
options = onnxruntime.SessionOptions()
options.log_severity_level, options.intra_op_num_threads = 4, 1
session = onnxruntime.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
session.run(["centre_px", "visible"], {"lines": numpy.zeros((int(sys.argv[2]), int(sys.argv[3])), "f4")})
"""
"""Program that runs a model once; arguments: model, lines, pixels, and limits on Linux: bytes, processor seconds."""
_TRIAL_BYTES, _TRIAL_S = 2 * 2**30, 20
"""Bounds of a batch. The example's network takes 0.27 GB and 1.8 s of processor time for 2,048 pixels, imports included
(one core of a Xeon)."""

_INPUTS = {"lines"}
_OUTPUTS = {"centre_px", "visible"}


def find_learned(profiles: np.ndarray, model: str | Path, *, clip: float) -> tuple[np.ndarray, np.ndarray]:
    """Return status (L,) uint8 and centre (L,) float64 on each of the profiles (N, L), from a model file.

    Centres are NaN unless the status is OK. Pixels at the grey value ``clip`` are saturated. DescriptionError if the
    file is not such a model; SetupError if ONNX Runtime is not installed.
    """
    count, lines = profiles.shape
    padded = -(-count // PIXELS_MULTIPLE) * PIXELS_MULTIPLE
    session = _session(str(model), _stamp(Path(model)), padded)
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
    require_regular_file(model, called=_CALLED)
    status = os.stat(model)
    return status.st_mtime_ns, status.st_size


def read_model_of_lines(model: str | Path) -> None:
    """Check the content of a model file without running it.

    Raises DescriptionError if it is no ONNX model, has other inputs and outputs, an operator that is not in
    `_OPERATORS`, subgraphs, functions, or data in other files; SetupError if the library is not installed.
    """
    onnx = optional_library("onnx", needed_by="the method learned", extra="learn")
    content = read_bytes(model, most_bytes=_MOST_BYTES, called=_CALLED)
    try:
        found = onnx.load_model_from_string(content)
    except Exception as error:
        # protobuf's errors have no public common type.
        raise DescriptionError(f"{model} cannot be read as an ONNX model: {shorten(str(error))}") from error
    graph = found.graph
    attributes = [each for node in graph.node for each in node.attribute]
    tensors = [*graph.initializer, *(each.t for each in attributes), *(t for each in attributes for t in each.tensors)]
    foreign = {node.op_type for node in graph.node if node.domain not in ("", "ai.onnx")}
    foreign |= {node.op_type for node in graph.node} - set(_OPERATORS.split())
    if foreign:
        raise DescriptionError(
            f"{model} has the operators {shorten(', '.join(sorted(map(repr, foreign))))}, which this program does not "
            "run; expected a network without loops and branches: export it with standard operators"
        )
    if found.functions or any(each.HasField("g") or each.graphs for each in attributes):
        raise DescriptionError(f"{model} has functions or subgraphs; expected a plain network: export it without them")
    if any(each.external_data or each.data_location for each in (*tensors, *_sparse_parts(graph, attributes))):
        raise DescriptionError(f"{model} refers to data in other files; expected one file: save its weights inside")
    held = {each.name for each in graph.initializer}
    inputs, outputs = {each.name for each in graph.input} - held, {each.name for each in graph.output}
    if inputs != _INPUTS or not outputs >= _OUTPUTS:
        raise DescriptionError(
            f"{model} has the inputs {sorted(map(str, inputs))} and outputs {sorted(map(str, outputs))}; expected the "
            f"input {sorted(_INPUTS)} and the outputs {sorted(_OUTPUTS)} (docs/examples/learned_stripe)"
        )


def _sparse_parts(graph: Any, attributes: list[Any]) -> list[Any]:
    """Return the tensors of values and indices of all sparse tensors."""
    sparse = [*graph.sparse_initializer, *(each.sparse_tensor for each in attributes)]
    sparse += [each for one in attributes for each in one.sparse_tensors]
    return [part for each in sparse for part in (each.values, each.indices)]


def _require_bounded(model: str, pixels: int) -> None:
    """Run a model once in another process, with limits of memory and time; raises DescriptionError if it fails."""
    command = [sys.executable, "-c", _TRIAL, model, *map(str, (_LINES, pixels, _TRIAL_BYTES, _TRIAL_S))]
    try:
        done = subprocess.run(command, capture_output=True, timeout=6 * _TRIAL_S, check=False)
        failed, said = done.returncode, done.stderr.decode(errors="replace").strip().splitlines()[-1:]
    except subprocess.TimeoutExpired:
        failed, said = 1, []
    if failed:
        raise DescriptionError(
            f"{model} cannot be run by ONNX Runtime on {_LINES} lines of {pixels} pixels with {_TRIAL_BYTES / 2**30:g} "
            f"GiB of memory in {_TRIAL_S} s{': ' if said else ''}{shorten(''.join(said))}"
        )


@lru_cache(maxsize=4)
def _session(model: str, stamp: tuple[int, int], pixels: int) -> Any:
    onnxruntime = optional_library("onnxruntime", needed_by="the method learned", extra="learn")
    read_model_of_lines(model)
    _require_bounded(model, pixels)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise DescriptionError(f"{model} cannot be read as an ONNX model by ONNX Runtime: {error}") from error
