"""Small U-Net across the stripe: its input is a profile line, its output a probability map of the stripe's centre.

Layers are those of Ronneberger et al. (MICCAI 2015) in one dimension. The map is a softmax over the line's pixels and
the class "no stripe". The centre is the mean of the map about its highest pixel, with subpixel resolution.
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

CHANNELS = 12, 20, 32, 48
"""Channels of the levels; each level has half the pixels of the previous one."""
KERNEL = 5
NEAR_PX = 4
"""Pixels on either side of the map's highest pixel that are averaged for the centre."""

Weights = list[tuple[jax.Array, jax.Array]]


def layers() -> list[tuple[int, int, int]]:
    """Return kernel, input and output channels of all convolutions in order: down, up, map, and "no stripe"."""
    sizes, last = [], 2
    for channels in CHANNELS:
        sizes += [(KERNEL, last, channels), (KERNEL, channels, channels)]
        last = channels
    for channels in CHANNELS[-2::-1]:
        sizes += [(KERNEL, last + channels, channels), (KERNEL, channels, channels)]
        last = channels
    return [*sizes, (1, last, 1), (1, CHANNELS[-1], 1)]


def new_weights(seed: int) -> Weights:
    """Random weights (He et al., ICCV 2015)."""
    rng = np.random.default_rng(seed)
    return [
        (jnp.asarray(rng.normal(0, (2 / (k * i)) ** 0.5, (k, i, o)), jnp.float32), jnp.zeros(o)) for k, i, o in layers()
    ]


def _convolved(x: jax.Array, layer: tuple[jax.Array, jax.Array]) -> jax.Array:
    shape = ("NWC", "WIO", "NWC")
    return jax.lax.conv_general_dilated(x, layer[0], (1,), "SAME", dimension_numbers=shape) + layer[1]


def logits(weights: Weights, lines: jax.Array) -> jax.Array:
    """Return logits (B, P + 1) of the pixels and of "no stripe", for lines (B, P) scaled to a full scale of 1."""
    given = iter(weights)
    # The square root makes shot noise uniform; division by the line's maximum shows faint stripes.
    lines = jnp.maximum(lines, 0.0)
    x = jnp.stack([jnp.sqrt(lines), lines / (lines.max(axis=1, keepdims=True) + 1e-3)], axis=-1)
    passed = []
    for level in range(len(CHANNELS)):
        for _ in range(2):
            x = jax.nn.relu(_convolved(x, next(given)))
        if level < len(CHANNELS) - 1:
            passed.append(x)
            x = x.reshape(x.shape[0], x.shape[1] // 2, 2, x.shape[2]).max(axis=2)
    deepest = x
    for skipped in reversed(passed):
        x = jnp.concatenate([jnp.repeat(x, 2, axis=1), skipped], axis=2)
        for _ in range(2):
            x = jax.nn.relu(_convolved(x, next(given)))
    pixels = _convolved(x, next(given))[..., 0]
    none = _convolved(deepest.mean(axis=1, keepdims=True), next(given))[:, 0]
    return jnp.concatenate([pixels, none], axis=1)


def centres(found: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return centres (B,) in px and the probabilities (B,) of a stripe, from logits (B, P + 1)."""
    chance = jax.nn.softmax(found, axis=1)[:, :-1]
    place = jnp.arange(chance.shape[1], dtype=jnp.float32)
    near = chance * (jnp.abs(place - chance.argmax(axis=1)[:, None]) <= NEAR_PX)
    visible = near.sum(axis=1)
    return (near * place).sum(axis=1) / (visible + 1e-9), visible


def write_onnx(weights: Weights, path: Path) -> None:
    """Write `centres` of `logits` as a model for ``--stripe-method learned``, with lines of any number and length."""
    nodes, held = [], []

    def constant(name: str, value: np.ndarray) -> str:
        held.append(numpy_helper.from_array(value, name))
        return name

    def node(kind: str, inputs: list[str], name: str, **how: object) -> str:
        nodes.append(helper.make_node(kind, inputs, [name], **how))
        return name

    given = iter(enumerate(weights))

    def convolved(x: str, *, relu: bool = True) -> str:
        k, (kernel, bias) = next(given)
        w = constant(f"w{k}", np.ascontiguousarray(np.asarray(kernel).transpose(2, 1, 0)))
        half = kernel.shape[0] // 2
        x = node("Conv", [x, w, constant(f"b{k}", np.asarray(bias))], f"c{k}", pads=[half, half])
        return node("Relu", [x], f"r{k}") if relu else x

    first, last = constant("first", np.array([1], np.int64)), constant("last", np.array([2], np.int64))
    lines = node("Relu", ["lines"], "positive")
    highest = node("Add", [node("ReduceMax", [lines, first], "max"), constant("eps", np.float32(1e-3))], "highest")
    two = [node("Sqrt", [lines], "root"), node("Div", [lines, highest], "share")]
    x = node("Concat", [node("Unsqueeze", [each, first], f"{each}_1") for each in two], "input", axis=1)
    passed = []
    for level in range(len(CHANNELS)):
        x = convolved(convolved(x))
        if level < len(CHANNELS) - 1:
            passed.append(x)
            x = node("MaxPool", [x], f"half{level}", kernel_shape=[2], strides=[2])
    deepest = x
    doubled = constant("doubled", np.array([1, 1, 2], np.float32))
    for level, skipped in enumerate(reversed(passed)):
        how = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        x = node("Resize", [x, "", doubled], f"up{level}", **how)
        x = convolved(convolved(node("Concat", [x, skipped], f"both{level}", axis=1)))
    pixels = node("Squeeze", [convolved(x, relu=False), first], "pixels")
    none = convolved(node("ReduceMean", [deepest, last], "mean", keepdims=1), relu=False)
    none = node("Squeeze", [none, first], "none")
    found = node("Softmax", [node("Concat", [pixels, none], "found", axis=1)], "chances", axis=1)
    count = node("Shape", ["lines"], "shape", start=1)
    zero, one = constant("zero", np.array(0, np.int64)), constant("one", np.array(1, np.int64))
    chance = node("Slice", [found, constant("from", np.array([0], np.int64)), count, first], "chance")
    places = node("Range", [zero, node("Squeeze", [count], "pixel_count"), one], "places")
    top = node("ArgMax", [chance], "top", axis=1, keepdims=1)
    away = node("Abs", [node("Sub", [places, top], "from_top")], "away")
    is_near = node("LessOrEqual", [away, constant("near_px", np.array(NEAR_PX, np.int64))], "is_near")
    near = node("Cast", [is_near], "near", to=TensorProto.FLOAT)
    near = node("Mul", [chance, near], "near_chance")
    visible = node("ReduceSum", [near, first], "visible", keepdims=0)
    weighted = node("Mul", [near, node("Cast", [places], "place", to=TensorProto.FLOAT)], "weighted")
    moment = node("ReduceSum", [weighted, first], "moment", keepdims=0)
    node("Div", [moment, node("Add", [visible, constant("tiny", np.float32(1e-9))], "mass")], "centre_px")
    shape = helper.make_tensor_value_info("lines", TensorProto.FLOAT, ["lines", "pixels"])
    outputs = [helper.make_tensor_value_info(each, TensorProto.FLOAT, ["lines"]) for each in ("centre_px", "visible")]
    graph = helper.make_graph(nodes, "stripe", [shape], outputs, held)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
