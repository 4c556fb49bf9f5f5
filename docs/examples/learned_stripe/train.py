"""Train a network to see the stripe on data sets of the twin, on the CPU, and write it as an ONNX model.

twin dataset clean.toml --scenes 80 --out runs/clean          # also turbid.toml and shiny.toml
python train.py runs/clean runs/turbid runs/shiny --out stripe.onnx --minutes 15
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from network import NEAR_PX, Weights, centres, logits, new_weights, write_onnx

import twin
from twin.datasets.data_set import LineStatus

CROP_PX, BATCH = 256, 256
SPREAD_PX = 0.8
"""Standard deviation of the target map about the true centre."""
CENTRE_WEIGHT = 1.0
"""Weight of the centre's error in px relative to the map's cross entropy."""
RATE = 3e-3
NO_STRIPE = -1.0


def read_lines(folders: list[Path], split: str) -> tuple[np.ndarray, np.ndarray]:
    """Return lines (N, P) of uint8 and the true centre (N,) on each, `NO_STRIPE` on lines without a stripe.

    Faint stripes are left out, and stripes whose centre cannot be known to a pixel, as under saturated daylight.
    """
    images, truths = [], []
    for folder in folders:
        for sample in twin.load_dataset(folder, split=split, names=("image", "centre_px", "status", "bound_px")):
            status, centre = sample["status"], sample["centre_px"]
            seen = np.isin(status, (LineStatus.VISIBLE, LineStatus.SATURATED)) & (sample["bound_px"] < 1)
            none = np.isin(status, (LineStatus.NOT_CROSSED, LineStatus.SHADOWED, LineStatus.LASER_OFF))
            kept = seen | none
            images.append(np.ascontiguousarray(sample["image"].T[kept]))
            truths.append(np.where(seen, centre, NO_STRIPE)[kept])
    return np.concatenate(images), np.concatenate(truths).astype(np.float32)


def batches(lines: np.ndarray, truth: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield random crops of random lines, half of them reversed; a crop beside the stripe is labelled `NO_STRIPE`."""
    longest = lines.shape[1] - CROP_PX
    while True:
        chosen = rng.integers(0, len(lines), BATCH)
        centre = truth[chosen]
        # Most crops contain the stripe; near their border its profile is cut off.
        first = np.where(centre >= 0, centre - rng.uniform(0, CROP_PX, BATCH), rng.uniform(0, longest, BATCH))
        first = np.clip(first, 0, longest).astype(int)
        part = lines[chosen[:, None], first[:, None] + np.arange(CROP_PX)].astype(np.float32) / 255.0
        centre = np.where(centre >= 0, centre - first, NO_STRIPE)
        turned = rng.random(BATCH) < 0.5
        part[turned] = part[turned, ::-1]
        centre[turned & (centre >= 0)] = CROP_PX - 1 - centre[turned & (centre >= 0)]
        yield part, centre.astype(np.float32)


def loss(weights: Weights, lines: jax.Array, centre: jax.Array) -> jax.Array:
    """Cross entropy of the map, and the error of its mean about the true centre."""
    found = logits(weights, lines)
    place = jnp.arange(lines.shape[1], dtype=jnp.float32)
    away = place - centre[:, None]
    wanted = jnp.exp(-0.5 * jnp.square(away / SPREAD_PX))
    wanted = wanted / (wanted.sum(axis=1, keepdims=True) + 1e-9)
    seen = centre >= 0
    wanted = jnp.concatenate([jnp.where(seen[:, None], wanted, 0.0), (~seen)[:, None].astype(jnp.float32)], axis=1)
    entropy = -(wanted * jax.nn.log_softmax(found, axis=1)).sum(axis=1)
    near = jax.nn.softmax(found, axis=1)[:, :-1] * (jnp.abs(away) <= NEAR_PX)
    error = (near * away).sum(axis=1) / (near.sum(axis=1) + 1e-3)
    return jnp.mean(entropy + CENTRE_WEIGHT * jnp.where(seen, jnp.abs(error), 0.0))


def trained(lines: np.ndarray, truth: np.ndarray, *, minutes: float, seed: int) -> Weights:
    """Train for ``minutes`` and return the weights; the learning rate decreases to zero over this time."""
    weights = new_weights(seed)
    optimiser = optax.inject_hyperparams(optax.adam)(learning_rate=RATE)
    state = optimiser.init(weights)

    @jax.jit
    def step(weights: Weights, state: optax.OptState, lines: jax.Array, centre: jax.Array):
        value, slope = jax.value_and_grad(loss)(weights, lines, centre)
        change, state = optimiser.update(slope, state)
        return optax.apply_updates(weights, change), state, value

    begun, shown, values = time.monotonic(), 0.0, []
    for part, centre in batches(lines, truth, np.random.default_rng(seed)):
        passed = (time.monotonic() - begun) / (60 * minutes)
        if passed >= 1:
            break
        # Cosine from the first rate to zero (Loshchilov and Hutter, ICLR 2017).
        state.hyperparams["learning_rate"] = jnp.asarray(RATE * 0.5 * (1 + np.cos(np.pi * passed)))
        weights, state, value = step(weights, state, part, centre)
        values.append(float(value))
        if passed >= shown:
            print(f"{100 * passed:3.0f} %, {len(values)} steps, loss {np.mean(values[-50:]):.3f}", flush=True)
            shown += 0.05
    return weights


def main() -> None:
    """Train, evaluate on the validation scenes, and write the model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="data sets of twin dataset with the label centre")
    parser.add_argument("--out", type=Path, required=True, help="ONNX model to write")
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    lines, truth = read_lines(given.folders, "train")
    print(f"{len(lines)} lines, {np.mean(truth >= 0):.0%} with a stripe")
    weights = trained(lines, truth, minutes=given.minutes, seed=given.seed)
    lines, truth = read_lines(given.folders, "validation")
    parts = [
        jax.jit(lambda x: centres(logits(weights, x)))(part / np.float32(255)) for part in np.array_split(lines, 20)
    ]
    centre, visible = (np.concatenate([np.asarray(part[k]) for part in parts]) for k in (0, 1))
    seen, found = truth >= 0, visible >= 0.5
    error = centre - truth
    print(
        f"validation: {np.mean(found[seen]):.1%} of the stripes found, {np.mean(found[~seen]):.2%} of the other lines "
        f"taken for one; median error {np.median(np.abs(error[seen & found])):.3f} px"
    )
    write_onnx(weights, given.out)
    print(f"wrote {given.out}")


if __name__ == "__main__":
    main()
