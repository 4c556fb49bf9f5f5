"""Cases of the study of stripe errors, and values of the thesis for comparison."""

from stripe_cases import Case

from twin.rendering_options import ALL, NONE, Effects
from uwlts.model.library import load_sensor

PLACES = {
    "plane": {"near": -60.0, "stand-off": 0.0, "far": 90.0},
    "spheres": {"near": -40.0, "stand-off": 15.0, "far": 85.0},
}
"""Z of the shipped scenes' placements."""
GROUPS = {
    "noise": ("noise", "fixed-pattern"),
    "speckle": ("speckle",),
    "defocus": ("defocus",),
    "scatter": ("haze", "multiple-scattering"),
    "gloss and light between surfaces": ("gloss", "secondary-light"),
}
CORE = ("noise", "fixed-pattern", "speckle", "defocus")
DEPTHS = (-80.0, -60.0, -30.0, 0.0, 30.0, 60.0, 90.0, 120.0)
F_NUMBERS = (2.8, 4.0, 5.6, 8.0, 11.0, 16.0)
TURBIDITIES = (0.0, 1.0, 2.0, 2.5, 3.0)
LEVELS = (0.2, 0.4, 0.8, 1.2, 1.6, 2.4, 4.0, 8.0)
THESIS_STD = {
    ("plane", "water"): {"near": (0.07, 0.10), "stand-off": (0.10, 0.09), "far": (0.10, 0.09)},
    ("plane", "air"): {"near": (0.05, 0.09), "stand-off": (0.06, 0.07), "far": (0.05, 0.06)},
    ("spheres", "water"): {"near": (0.17, 0.13), "stand-off": (0.135, 0.115), "far": (0.11, 0.10)},
    ("spheres", "air"): {"near": (0.095, 0.085), "stand-off": (0.09, 0.08), "far": (0.085, 0.075)},
}
"""Thesis, Tables 2, 3, 6, 7, mm: polynomial and proposed method, square planes, means of two positions of spheres."""


def exactly(*names: str) -> Effects:
    """Return only the named effects."""
    return ALL.remove(*(name for name in ALL.names() if name not in names))


NAME_ALL, NAME_CORE = "all", "noise + speckle + defocus"
ROWS = {
    "none": NONE,
    **{f"only {group}": exactly(*names) for group, names in GROUPS.items()},
    NAME_CORE: exactly(*CORE),
    NAME_ALL: ALL,
}


class Plan:
    """Cases of the study and their number of frames, which is smaller for cases with slow random walks."""

    def __init__(self, frames: int):
        self.frames = frames

    def case(self, effects: Effects, **changes: object) -> Case:
        walks = effects.multiple_scattering or effects.secondary_light
        return Case(**{"effects": effects, "frames": max(2, self.frames // 2) if walks else self.frames} | changes)

    def effects(self, thing: str) -> dict[tuple[str, str], Case]:
        """Return cases by row and place."""
        return {
            (name, place): self.case(effects, thing=thing, z_mm=z)
            for name, effects in ROWS.items()
            for place, z in PLACES[thing].items()
        }

    def depth(self) -> dict[tuple[str, float], Case]:
        rows = ("only noise", "only speckle", "only defocus", NAME_CORE)
        return {(name, z): self.case(ROWS[name], z_mm=z) for name in rows for z in DEPTHS}

    def f_number(self) -> dict[tuple[str, str, float], Case]:
        """By row, place and f-number."""
        wanted = [(NAME_CORE, place) for place in PLACES["plane"]]
        wanted += [("only speckle", "stand-off"), ("only defocus", "near")]
        return {
            (name, place, number): self.case(ROWS[name], z_mm=PLACES["plane"][place], camera=(("f_number", number),))
            for name, place in wanted
            for number in F_NUMBERS
        }

    def turbidity(self) -> dict[tuple[str, float], Case]:
        """Return cases with few frames and samples, because random walks take long in turbid water."""
        rows = {
            "scattered once": exactly("haze"),
            "scattered once or more often": ROWS["only scatter"],
            NAME_ALL: ALL,
            "all but scatter": ALL.remove(*GROUPS["scatter"]),
        }
        return {
            (name, water): self.case(effects, water=water, frames=2, spp=16)
            for name, effects in rows.items()
            for water in TURBIDITIES
        }

    def gloss(self) -> dict[tuple[str, str], Case]:
        rows = {
            "diffuse": NONE,
            "glossy": exactly("gloss"),
            "diffuse, light between surfaces": exactly("secondary-light"),
            "glossy, light between surfaces": ROWS["only gloss and light between surfaces"],
        }
        return {
            (thing, name): self.case(effects, thing=thing, frames=3)
            for thing in ("step", "pipe")
            for name, effects in rows.items()
        }

    def exposure(self) -> dict[tuple[str, float], Case]:
        return {
            (name, level): self.case(ROWS[name], level=level) for name in ("only noise", NAME_CORE) for level in LEVELS
        }

    def unknown(self) -> dict[tuple[str, str], Case]:
        """Return cases that each change one parameter unknown from the thesis, by change and place."""
        sensor = load_sensor("thesis")
        window, focus = sensor.camera.window, sensor.camera.focus_distance_mm
        # Near the axis, the apparent thickness of a flat layer is its thickness divided by its index.
        in_water = (focus - window.distance_mm - window.thickness_mm) / sensor.media["water"].refractive_index(635.0)
        sharp = window.distance_mm + window.thickness_mm / window.glass + in_water
        changes = {
            "as described": {},
            "f/8 instead of f/4": {"camera": (("f_number", 8.0),)},
            f"lens focused for the stand-off in water (at {sharp:.0f} mm instead of {focus:.0f} mm in air)": {
                "camera": (("focus_distance_mm", sharp),)
            },
            "sheet's waist radius 0.15 mm instead of 0.3 mm": {"laser": (("waist_radius_mm", 0.15),)},
            "sheet's waist radius 0.6 mm": {"laser": (("waist_radius_mm", 0.6),)},
            "laser's spectrum 1 nm wide instead of 0": {"laser": (("linewidth_nm", 1.0),)},
        }
        return {
            (name, place): self.case(ROWS[NAME_CORE], z_mm=z, **change)
            for name, change in changes.items()
            for place, z in PLACES["plane"].items()
        }

    def pictures(self) -> dict[tuple[str, str], Case]:
        """One frame each, by water and row."""
        rows = ("none", "only defocus", "only speckle", "only noise", NAME_ALL)
        waters, near = ("coastal", "harbour"), PLACES["plane"]["near"]
        return {(w, name): self.case(ROWS[name], water=w, z_mm=near, frames=1, spp=16) for w in waters for name in rows}

    def every_case(self) -> list[Case]:
        """All cases, each once."""
        studies = (
            self.effects("plane"),
            self.effects("spheres"),
            self.depth(),
            self.f_number(),
            self.turbidity(),
            self.gloss(),
            self.exposure(),
            self.unknown(),
            self.pictures(),
        )
        return list(dict.fromkeys(case for study in studies for case in study.values()))
