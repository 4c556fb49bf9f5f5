"""Wrong and lost points on scenes with mirrors and inside corners: the brightest peak, and the direct stripe.

``python docs/studies/stripe_reflections.py`` prints each scene and the table of docs/results/reflections.md, and draws
its picture; ``--write`` puts the table there. A point is correct within 3 px of a true position, otherwise wrong. True
positions are the intersections of the sheet's middle with surfaces, and the stripes of direct light, which differ if an
edge cuts the sheet. A profile line is lost if the sheet's middle lights a surface there and no point is correct. The
parameters of the rule were chosen only on the named scenes, with a small camera.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from cyclopts import App
from result_tables import publish, table
from scipy.spatial import cKDTree

from twin.rendering_options import ALL, Options, use_variant
from twin.scene.description import Scene, load_scene
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.stripe import StripeOptions, extract_candidates, find_stripes

NEAR_PX, FRAMES, STEP_MM = 3.0, 5, 5.0
BRIGHTEST = StripeOptions(peak="strongest", ambiguous_ratio=1.0)
FAINTEST = StripeOptions(threshold_floor=0.5)
LONGER_WAYS = ("haze", "multiple-scattering", "secondary-light")
PICTURE = Path("docs/pictures/stripe-reflections.png")
PICTURED = "inside corner, 12°"
Thing = dict[str, Any]


def mirror(z: float, reflectance: float = 0.02, share: float = 0.85) -> Thing:
    size = {"width_mm": 160.0, "height_mm": 200.0}
    return {"kind": "plate", **size, "position_mm": [0, 0, z], "reflectance": reflectance, "mirror": share}


def sphere(diameter: float = 50.0, at: tuple[float, float, float] = (0, 0, 0), finish: str = "painted") -> Thing:
    return {"kind": "sphere", "diameter_mm": diameter, "position_mm": at, "finish": finish}


def block(size: tuple[float, float, float], at: tuple[float, float, float], **more: Any) -> Thing:
    return {"kind": "block", "size_mm": size, "position_mm": at, "finish": "metal"} | more


def corner(side: str, *, high: float = 40.0, **finish: Any) -> list[Thing]:
    """Return a floor with a wall: beside the stripe's middle (y, -y), or along it and in view of the camera (x)."""
    z = -0.5 * high + 10.0
    wall = {
        "y": ((100, 40, high), (0, 50, z)),
        "-y": ((100, 40, high), (0, -50, z)),
        "x": ((40, 140, high), (20, 0, z)),
    }
    return [block((100, 140, 20), (0, 0, 20), **finish), block(*wall[side], **finish)]


def scene(*things: Thing, turned: Any = (0, 0, 0), at: Any = (0, 0, 0), water: Any = None) -> Scene:
    motion = {"start_mm": -0.5 * STEP_MM * (FRAMES - 1), "step_mm": STEP_MM, "count": FRAMES}
    table: dict[str, Any] = {"title": "", "medium": "water", "objects": list(things), "motion": motion, "water": water}
    placement = {"position_mm": at, "rotation_deg": turned}
    return Scene.model_validate(table | {"placements": {"here": placement}, "placement": "here"})


SHINING = {"mirror": 0.4, "reflectance": 0.5}
NAMED = {
    "sphere on a mirror": scene(sphere(), mirror(25.0)),
    "sphere on a mirror, 20°": scene(sphere(), mirror(25.0), turned=(20, 0, 0)),
    "sphere above a mirror, 10° and 8°, coastal": scene(
        sphere(40.0, (0, 20, -12)), mirror(25.0, 0.05), turned=(10, 8, 0), water="coastal"
    ),
    "step standard on a mirror": load_scene("step"),
    "painted block on a mirror, 15°": scene(
        block((80, 40, 40), (0, 10, 0), finish="painted"), mirror(20.0, 0.04), turned=(15, 0, 0)
    ),
    "grey block on a mirror, -25°": scene(
        block((80, 40, 40), (0, -10, 0), finish="diffuse", reflectance=0.3),
        mirror(20.0, 0.03),
        turned=(-25, 0, 0),
        at=(0, 0, 40),
    ),
    PICTURED: scene(*corner("y", **SHINING), turned=(12, 0, 0)),
    "inside corner, 8°, coastal": scene(*corner("y", mirror=0.7, reflectance=0.25), turned=(8, 0, 0), water="coastal"),
    "inside corner, 25° and 5°": scene(
        *corner("y", finish="diffuse", mirror=0.3, reflectance=0.4), turned=(25, 5, 0), at=(0, 10, -30)
    ),
    "inside corner, turned about all axes": scene(*corner("y", mirror=0.6, reflectance=0.3), turned=(10, 10, 20)),
    "corner along the stripe": scene(*corner("x", **SHINING)),
    "clean corner along the stripe": scene(
        *corner("x", finish="diffuse", mirror=0.85, reflectance=0.1), turned=(5, 0, 3)
    ),
    "sphere on a mirror, -18° and 4°, coastal": scene(
        sphere(40.0), mirror(20.0, 0.03), turned=(-18, 4, 0), at=(0, 0, 30), water="coastal"
    ),
    "two spheres on a mirror, 14°, -5°, 10°": scene(
        sphere(30.0, (0, -32, 0)), sphere(30.0, (0, 32, 0)), mirror(15.0, 0.04), turned=(14, -5, 10)
    ),
    "PVC sphere on a mirror, 25°, near": scene(
        sphere(50.0, finish="pvc"), mirror(25.0, 0.05, 0.7), turned=(25, 0, 0), at=(0, 0, -40)
    ),
    "PVC block on a mirror, -12° and 6°, far": scene(
        block((80, 50, 30), (0, 0, 0), finish="pvc"), mirror(15.0, 0.04), turned=(-12, 6, 0), at=(0, 0, 60)
    ),
    "inside corner, 15° and -6°, turbid": scene(
        *corner("-y", finish="diffuse", mirror=0.5, reflectance=0.3), turned=(-15, -6, 0), water=1.0
    ),
    "inside corner, 18° and 3°, far": scene(
        *corner("y", mirror=0.6, reflectance=0.3), turned=(18, 3, 0), at=(0, 0, 60)
    ),
    "high inside corner, 10°, coastal": scene(
        *corner("y", high=70.0, finish="diffuse", mirror=0.6, reflectance=0.3), turned=(10, 0, 0), water="coastal"
    ),
    "corner along the stripe, 3° and -4°": scene(
        *corner("x", finish="diffuse", mirror=0.6, reflectance=0.25), turned=(3, 0, -4)
    ),
    "sphere on paint": scene(sphere(), block((160, 200, 10), (0, 0, 30), finish="painted"), turned=(5, 5, 0)),
}

OTHERS_DRAWN = tuple(range(5000, 5015))
"""Seeds of scenes drawn at random, seen by the other sensors in turn."""


def drawn(seed: int) -> tuple[str, Scene]:
    """Return name and random scene: objects on a mirror, or an inside corner of shiny faces, in a random water."""
    rng = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 2)

    kind = ("mirror", "corner beside the stripe", "corner along the stripe")[rng.choice(3, p=(0.5, 0.35, 0.15))]
    water = (None, "coastal", 1.0)[rng.choice(3, p=(0.5, 0.3, 0.2))]
    tilt = between(-30.0, 30.0)
    if kind == "mirror":
        things = [mirror(between(15.0, 30.0), between(0.02, 0.06), between(0.5, 0.9))]
        for _ in range(rng.integers(1, 4)):
            at, finish = (between(-10, 10), between(-50, 50), between(-10, 5)), ("painted", "pvc")[rng.integers(2)]
            if rng.random() < 0.5:
                things.append(sphere(between(15, 50), at, finish))
            else:
                size = between(20, 80), between(15, 50), between(10, 40)
                things.append(block(size, at, finish=finish))
    else:
        share = between(0.3, 0.8)
        shine = {"mirror": share, "reflectance": min(between(0.1, 0.5), round(0.95 - share, 2))}
        if rng.random() < 0.5:
            shine["finish"] = "diffuse"
        side = "x" if "along" in kind else ("y", "-y")[rng.integers(2)]
        # The corner is turned so that the camera looks into it.
        tilt = abs(tilt) if side == "y" else -abs(tilt) if side == "-y" else tilt / 5
        things = corner(side, high=between(25, 80), **shine)
    turned = tilt, between(-8, 8), between(-20, 20)
    at = 0.0, between(-10, 10), between(-40, 60)
    name = f"{seed}: {kind}, turned by {turned[0]:g}°, {turned[1]:g}°, {turned[2]:g}°, {water or 'clear'}"
    return name, scene(*things, turned=turned, at=at, water=water)


def other(
    baseline_mm: float, angle_deg: float, *, along: str = "width", focal_mm: float = 6.25, **detector: Any
) -> Sensor:
    """Return the small sensor with another baseline and angle, focused at the crossing of camera and laser axes."""
    sensor, angle = load_sensor("thesis-small"), math.radians(angle_deg)
    camera = {"focus_distance_mm": baseline_mm / math.tan(angle), "stripe_along": along, "focal_length_mm": focal_mm}
    laser = {"baseline_mm": baseline_mm, "triangulation_angle_deg": angle_deg}
    laser |= {"waist_distance_mm": baseline_mm / math.sin(angle), "power_mw": detector.pop("power_mw", 7.0)}
    # Scenes are drawn up to 40 mm nearer than the stand-off; that of `HIGH` is 234 mm.
    parts = {"camera": camera, "laser": laser, "detector": detector, "volume": {"near_mm": 150.0}}
    changed = {name: getattr(sensor, name).model_copy(update=values) for name, values in parts.items()}
    return Sensor.model_validate(sensor.model_copy(update=changed).model_dump())


SHORT = other(160.0, 22.0)
HIGH = other(230.0, 40.0, along="height", focal_mm=5.0)
NOISY = other(300.0, 35.0, focal_mm=8.0, read_noise_e=60.0, power_mw=4.0)
PIPE = {"kind": "pipe", "diameter_mm": 50.0, "length_mm": 160.0, "finish": "painted"}
RIDGE = block((100, 60, 20), (0, -35, 20), mirror=0.4, reflectance=0.4)
OTHERS = {
    "short: pipe on a mirror": (SHORT, scene(PIPE, mirror(26.0, 0.04, 0.7), turned=(9, 4, 6))),
    "high: pipe on a mirror, coastal": (
        HIGH,
        scene(PIPE, mirror(26.0, 0.05, 0.5), turned=(-14, 0, -8), water="coastal"),
    ),
    "noisy: sphere in a corner": (
        NOISY,
        scene(*corner("y", mirror=0.5, reflectance=0.35), sphere(24.0, (0, -10, -2)), turned=(16, 3, 0)),
    ),
    "short: high corner": (SHORT, scene(*corner("-y", high=55.0, mirror=0.3, reflectance=0.4), turned=(-20, 2, 8))),
    "high: rod before a shining face": (
        HIGH,
        scene(
            block((100, 140, 20), (0, 0, 20), mirror=0.45, reflectance=0.3),
            block((80, 12, 12), (0, 5, -10), finish="painted"),
            turned=(6, -4, 12),
        ),
    ),
    "noisy: shining step": (
        NOISY,
        scene(RIDGE, block((100, 60, 40), (0, 30, 10), mirror=0.4, reflectance=0.4), turned=(11, 0, -6), at=(0, 0, 20)),
    ),
    "short: two blocks on a mirror, turbid": (
        SHORT,
        scene(
            mirror(20.0, 0.05, 0.6),
            block((60, 18, 30), (0, -25, 4), finish="pvc"),
            block((60, 18, 14), (0, 20, 12), finish="painted"),
            turned=(-10, 5, 3),
            water=1.0,
        ),
    ),
    "high: corner, 22°": (
        HIGH,
        scene(
            *corner("y", high=60.0, finish="diffuse", mirror=0.5, reflectance=0.3), turned=(22, -3, 5), at=(0, 0, 30)
        ),
    ),
}
"""Other sensors and their scenes."""


@dataclass(frozen=True)
class Rendered:
    """Images (F, H, W) of a scene, as `find_stripes` takes them, and the sensor.

    ``lit`` (N, 3) contains image, line and position of the points lit by the sheet's middle. ``direct`` (M, 3) contains
    those of the stripes of direct light.
    """

    images: np.ndarray
    lit: np.ndarray
    direct: np.ndarray
    sensor: Sensor

    @property
    def capture(self) -> Any:
        """Return an object with the attributes of a capture that `find_stripes` needs."""
        count = len(self.images)
        about = {"header": SimpleNamespace(sensor=self.sensor, saturation_dn=255), "path": Path("rendered.h5")}
        about |= {"laser_on": np.ones(count, bool), "stage_mm": np.arange(count), "exposure_ms": np.ones(count)}
        return _Capture(images=self.images, pose=np.full((count, 4, 4), np.nan), **about)


class _Capture(SimpleNamespace):
    def image(self, index: int) -> np.ndarray:
        return self.images[index]

    def __len__(self) -> int:
        return len(self.images)


def rendered(of: Scene, sensor: Sensor, options: Options = Options()) -> Rendered:
    from twin.recording.frame_truth import find_crossings
    from twin.recording.sensor_simulator import SensorSimulator

    studio, images, lit = SensorSimulator(sensor, of, options), [], []
    for number, shot in enumerate(of.motion.shots()):
        images.append(studio.frame(shot, number).image)
        found = find_crossings(studio.renderer, studio.pose(shot))
        shone = found.brightness > 0
        lit.append(np.column_stack([np.full(shone.sum(), number), found.line[shone], found.centre_px[shone]]))
    return Rendered(np.stack(images), np.concatenate(lit), direct_light(of, sensor, options), sensor)


def rendered_small(of: Scene, sensor: Sensor, seed: int) -> Rendered:
    """Render three images of a scene with fewer samples, which suffice for small cameras."""
    motion = of.motion.model_copy(update={"start_mm": -STEP_MM, "count": 3})
    return rendered(of.model_copy(update={"motion": motion}), sensor, Options(spp=8, seed=seed))


def direct_light(of: Scene, sensor: Sensor, options: Options) -> np.ndarray:
    """Return image, line and position (M, 3) of the stripes of direct light from surfaces, without mirrors."""
    from twin.recording.sensor_simulator import SensorSimulator

    studio = SensorSimulator(sensor, of, replace(options, effects=ALL.remove(*LONGER_WAYS)))
    full_scale, result = 255 / studio.sensor.detector.full_well_e, []
    for number, shot in enumerate(of.motion.shots()):
        light = full_scale * studio.expose(shot, number).direct
        own = extract_candidates(light, stripe_along=sensor.camera.stripe_along, options=FAINTEST)
        result.append(np.column_stack([np.full(len(own.line), number), own.line, own.centre_px]))
    return np.concatenate(result)


def wrong_and_lost(of: Rendered, options: StripeOptions) -> tuple[float, float, int, int]:
    """Return the percentages of wrong points and of lit lines without a correct point, and both numbers."""
    stripes, wrong, right = find_stripes(of.capture, options=options), 0, 0
    lines, places = np.unique(of.lit[:, :2], axis=0), np.concatenate([of.lit, of.direct])
    for number in range(len(of.images)):
        here = stripes[stripes.frame == number]
        tree = cKDTree(places[places[:, 0] == number, 1:])
        away = tree.query(np.column_stack([here.line, here.centre_px]))[0]
        wrong += int(np.count_nonzero(away > NEAR_PX))
        right += len(np.intersect1d(here.line[away <= NEAR_PX], lines[lines[:, 0] == number, 1]))
    count = len(stripes.line)
    return 100.0 * wrong / max(count, 1), 100.0 * (1.0 - right / len(lines)), count, len(lines)


def groups(seeds: range) -> Iterator[tuple[str, Iterator[tuple[str, Rendered]]]]:
    """Yield the images of the rows of the table, rendered on demand."""
    small, turns = load_sensor("thesis-small"), (SHORT, HIGH, NOISY)
    yield "rule chosen on these", ((name, rendered_small(of, small, 0)) for name, of in NAMED.items())
    yield (
        "three other sensors, seen before the last changes",
        chain(
            ((name, rendered_small(of, by, 7 + n)) for n, (name, (by, of)) in enumerate(OTHERS.items())),
            ((drawn(n)[0], rendered_small(drawn(n)[1], turns[n % 3], n)) for n in OTHERS_DRAWN),
        ),
    )
    four = (small, *turns)
    fresh = ((drawn(n)[0], rendered_small(drawn(n)[1], four[k % 4], n)) for k, n in enumerate(seeds))
    yield f"four sensors, drawn by {seeds.start} to {seeds.stop - 1}", fresh


def rows(seeds: range) -> Iterator[list[str]]:
    """Yield a row for each group of scenes; each scene is printed."""
    for title, group in groups(seeds):
        sums, worst, scenes = np.zeros((2, 2, 2)), 0.0, 0
        for name, shown in group:
            found = [wrong_and_lost(shown, options) for options in (BRIGHTEST, StripeOptions())]
            print(name, *(f"{value:.2f}" for wrong, lost, _, _ in found for value in (wrong, lost)), flush=True)
            sums += [((wrong * count, count), (lost * lines, lines)) for wrong, lost, count, lines in found]
            worst, scenes = max(worst, found[1][0]), scenes + 1
        shares = sums[:, :, 0] / sums[:, :, 1]
        cells = [f"{value:.{digits}f}" for share in shares for value, digits in zip(share, (2, 1), strict=True)]
        yield [title, f"{scenes}", f"{sums[1, 0, 1]:,.0f}", *cells, f"{worst:.1f}"]


def draw(of: Rendered) -> None:
    """Draw the corner: image, all candidates, and the stripes selected by both rules."""
    import matplotlib.pyplot as plt

    number = FRAMES // 2
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.6), sharex=True, sharey=True, layout="constrained")
    all_of_them = extract_candidates(of.images[number], stripe_along="width", saturation=255)
    shown = [(all_of_them.line, all_of_them.centre_px)]
    for options in (BRIGHTEST, StripeOptions()):
        stripes = find_stripes(of.capture, options=options)
        here = stripes[stripes.frame == number]
        shown.append((here.line, here.centre_px))
    titles = "all stripes of the image", "brightest peak", "direct stripe"
    for axis, (line, centre), title in zip(axes, shown, titles, strict=True):
        axis.imshow((of.images[number] / 255.0) ** 0.4, cmap="gray", interpolation="none")
        axis.plot(line, centre, ".", color="#d62728", markersize=1.5)
        axis.set(title=title, xlabel="profile line (column), px", xlim=(640, 1080), ylim=(700, 330))
    axes[0].set_ylabel("row, px")
    figure.savefig(PICTURE, dpi=110)


def main(*, first: int = 9600, count: int = 40, write: bool = False) -> None:
    """Print the table, with ``count`` scenes drawn by seeds from ``first`` on; with `--write`, put it into its page."""
    use_variant()
    head = ["scenes", "number", "points", "brightest peak: wrong %", "lost %", "direct stripe: wrong %", "lost %"]
    found = list(rows(range(first, first + count)))
    publish({"reflections": table([*head, "wrong %, worst scene"], found)}, write=write)
    if write:
        draw(rendered(NAMED[PICTURED], load_sensor("thesis")))


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
