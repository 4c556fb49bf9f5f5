"""Description of a folder of images to fill in: what the images show, and questions for the rest."""

import re
from collections import Counter, defaultdict
from glob import escape
from importlib.resources import files
from itertools import cycle, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment

from uwlts.errors import ImageError, OutputError, TargetError
from uwlts.files.writing import require_ending, write_file
from uwlts.storage.image_file import read_image
from uwlts.storage.import_.folder_description import NAME
from uwlts.storage.import_.grey_values import extract_channel
from uwlts.storage.import_.matching import image_files
from uwlts.storage.numbering import count_names, name_gaps
from uwlts.stripe.extract import direct_stripe_in
from uwlts.stripe.options import StripeOptions
from uwlts.targets.detection import convert_to_eight_bit, detect_lattice, find_largest_piece

_EXAMINED = 8  # images of a group that are examined, evenly spaced
_CHANNELS = ("red", "green", "blue", "red - max(green, blue)", "green - max(red, blue)", "blue - max(red, green)")
_LINES, _HEIGHT, _SMOOTH = 0.4, 0.35, 0.9
"""Of a laser line: least fraction of profile lines, height relative to the brightest pixels, share of steps below 3 px.
Chosen on tests/data/ciclop and etna: lines have 0.45, 0.52 and 0.96, edges of boards 0.3 at most in height."""
_CHANGED, _SAME = 0.1, 0.05
"""An image and its background differ by more than this fraction of the brightest pixel in less than this fraction of
the pixels: in 0.02 in tests/data/ciclop, other pairs there in 0.67 and more."""
_FOLLOWS = 0.7  # least correlation of the line's place with the board's pitch, which then shows the laser's side
_FEWEST_POINTS = 12  # of a target: images of tests/data/ciclop without a board have at most 6 by chance


class _Line(NamedTuple):
    along: str
    profile_lines: int
    place_px: float


class _Board(NamedTuple):
    kind: str
    columns: int
    rows: int
    pitch_px: float


class _Group:
    """Images whose names differ in their digits only, and what the examined ones show."""

    def __init__(self, folder: Path, names: list[str]):
        self.names = names
        self.patterns = sorted({re.sub("[0-9]", "?", escape(name)) for name in names}, key=len)
        chosen = np.unique(np.linspace(0, len(names) - 1, _EXAMINED).astype(int))
        self.images = [read_image(folder / names[place]) for place in chosen]
        self.colour = any(image.ndim == 3 and np.ptp(image, axis=2).any() for image in self.images)
        grey = [extract_channel(image, "grey" if self.colour else None, name="") for image in self.images]
        self.boards = [board for image in grey if (board := _find_board(image))]
        self.lines: list[_Line] = []
        self.channel, self.background = "?", None
        self.counted = count_names(names, series=True)
        self.gaps = name_gaps(names, self.counted)

    def find_lines(self, groups: list["_Group"]) -> None:
        """Find the laser's line in the images less those of another group, or else in the images themselves."""
        brightest = max(float(np.percentile(image, 99.9)) for image in self.images)
        for dark in (*groups, None):
            images = self.images if dark is None else self._subtract(dark)
            for channel in _CHANNELS if self.colour else (None,):
                grey = [extract_channel(each, channel, name="").clip(0).astype(each.dtype) for each in images]
                lines = [line for each in grey if (line := _find_line(each, brightest))]
                if sum(line.profile_lines for line in lines) > sum(line.profile_lines for line in self.lines):
                    self.lines, self.channel, self.background = lines, channel, dark
            if self.lines:
                break

    def _subtract(self, dark: "_Group") -> list[np.ndarray]:
        """Return the images less those of a group that differ from them by a line at most; else none."""
        if dark is self or len(dark.names) not in (1, len(self.names)):
            return []
        pairs = zip(self.images, cycle(dark.images), strict=False)
        changes = [image.astype(np.int32) - unlit for image, unlit in pairs]
        shares = [np.mean(np.abs(each) > _CHANGED * self.images[0].max()) for each in changes]
        return [] if max(shares) > _SAME else [each.clip(0).astype(self.images[0].dtype) for each in changes]


def write_template(folder: str | Path, out: str | Path | None = None) -> Path:
    """Write a description of a folder of images for `import_images`, as far as the images show it, to be filled in.

    Values that eight images of each kind do not show are "?", which an import refuses by name. ImageError without an
    image, or if images are damaged or of several sizes; OutputError if the description exists or cannot be written.

    Parameters
    ----------
    folder : str or Path
        Folder of PNG, TIFF, BMP or JPEG images of one camera.
    out : str or Path, optional
        Description to write; by default import.toml in the folder.

    Returns
    -------
    Path
        The description.
    """
    folder = Path(folder)
    out = folder / NAME if out is None else Path(out)
    if out.exists():
        raise OutputError(f"{out} exists already, and a template replaces nothing: fill it in, or give another name")
    require_ending(out, (".toml",))
    forms: dict[str, list[str]] = defaultdict(list)
    for name in image_files(folder):
        forms[re.sub("[0-9]+", "#", name)].append(name)
    groups = [_Group(folder, names) for names in forms.values()]
    shapes = {image.shape[:2] for group in groups for image in group.images}
    if len(shapes) > 1:
        found = ", ".join(f"{width} x {height}" for height, width in sorted(shapes))
        raise ImageError(f"images of {folder} have {found} pixels; expected one camera: move other images away")
    for group in groups:
        group.find_lines(groups)
    write_file(out, _fill_in(folder.resolve().name, groups))
    return out


def _find_line(image: np.ndarray, brightest: float) -> _Line | None:
    """Return the laser's line in a grey image (H, W); None if there is none as high and smooth as a laser's."""
    found, full = [], float(np.iinfo(image.dtype).max)
    for along, size in zip(("height", "width"), image.shape, strict=True):
        stripe = direct_stripe_in(image, stripe_along=along, options=StripeOptions(), saturation=full)
        heights, centres = stripe.amplitude[stripe.lines], stripe.centre_px[stripe.lines]
        enough = len(centres) > _LINES * size and np.median(heights) > _HEIGHT * brightest
        if enough and np.mean(np.abs(np.diff(centres)) < 3) > _SMOOTH:
            found.append(_Line(along, len(centres), float(np.median(centres))))
    return max(found, key=lambda line: line.profile_lines, default=None)


def _find_board(image: np.ndarray) -> _Board | None:
    """Return the chessboard or the array of circles in a grey image (H, W), with the numbers in view."""
    corners = find_largest_piece(convert_to_eight_bit(image))
    rows, columns = sorted(corners.shape[:2])
    if rows >= 3 and np.isfinite(corners[..., 0]).sum() >= _FEWEST_POINTS:
        steps = [float(np.nanmean(np.linalg.norm(np.diff(corners, axis=axis), axis=2))) for axis in (0, 1)]
        return _Board("chessboard", columns, rows, max(steps))
    try:
        lattice = detect_lattice(image)
    except TargetError:
        return None
    columns, rows = (np.ptp(lattice.indices, axis=0) + 1).tolist()
    pitch = float(np.sqrt(np.prod(np.ptp(lattice.circles.centres, axis=0)) / (columns * rows)))
    return _Board("circle grid", columns, rows, pitch) if len(lattice.indices) >= _FEWEST_POINTS else None


def _find_side(lasers: list[_Group], lamps: list[_Group], along: str) -> str | None:
    """Return the side of the camera with the laser: a line that is nearer, where the board is larger, moves to it."""
    left, right = ("left of", "right of") if along == "height" else ("above", "below")
    for laser, lamp in product(lasers, lamps):
        if len(laser.lines) == len(lamp.boards) == len(laser.images) == len(lamp.images) > 3:
            places, pitches = [line.place_px for line in laser.lines], [board.pitch_px for board in lamp.boards]
            follows = float(np.corrcoef(places, pitches)[0, 1])
            return right if follows > _FOLLOWS else left if follows < -_FOLLOWS else None
    return None


def _fill_in(name: str, groups: list[_Group]) -> str:
    """Return the text of the description of a folder."""
    lasers = [group for group in groups if 2 * len(group.lines) >= len(group.images)]
    dark = [group.background for group in lasers if group.background is not None]
    lamps = [group for group in groups if 2 * len(group.boards) >= len(group.images)]
    # The same scene without the laser shows the target at the positions of the laser images.
    lamps = [group for group in lamps if group in dark] or lamps
    roles = {"laser": lasers, "lamp": lamps, "background": [*dict.fromkeys(dark)]}
    roles["ignore"] = [group for group in groups if group not in (*lasers, *lamps, *dark)]
    boards = Counter(board[:3] for group in lamps for board in group.boards).most_common(1)
    along = next((line.along for group in lasers for line in group.lines), "")
    side, most = _find_side(lasers, lamps, along), max(int(image.max()) for group in groups for image in group.images)
    source = files("uwlts.storage.import_").joinpath("template.toml.j2").read_text(encoding="utf-8")
    template = Environment(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True).from_string(source)
    return template.render(name=name, groups=groups, roles=roles, boards=boards, along=along, side=side, most=most)
