"""Grid of a chessboard's corners: pixels with NaN for missing corners, and the quality of corners."""

from itertools import product

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from uwlts.targets.detection.blobs import check_grey
from uwlts.targets.detection.lattice import select_agreeing


class _Rule:
    """Numbers of the refinement and check of a chessboard's corners.

    Chosen by hand with the reasons below, not fitted to data. Results with these numbers are checked on the drawn
    boards of tests/uwlts/targets and on real photographs (tests/system/test_real_images.py).
    """

    sigma_px: float = 1.5  # blur before squares are compared, px
    residual: float = 1 / 30
    """Largest rms distance of the corners from even grids of `neighbourhood` corners, in side lengths of a square."""
    neighbourhood: int = 3
    """Corners along each side of a part of the board that must be an even grid in perspective. Over two squares of
    11 deg each, an equidistant lens departs from perspective by less than 1 % of a square."""
    alternating: float = 0.9  # least fraction of neighbouring squares that are dark and bright as expected
    reaches: tuple[float, ...] = (0.45, 0.3, 0.15)
    """Distances from a corner of the places where its squares are compared, in side lengths, tried in order: near
    the middles of whole squares, and within outer squares that the board's rim cuts to half or a fifth of their
    width."""
    far: float = 0.85
    """Distance beyond a side's corners, in side lengths, where outer squares that are not cut still alternate."""
    unlike: float = 0.6
    """Largest difference between opposite squares, as a fraction of that between dark and bright squares."""
    window: float = 2 / 3
    """Half side of the window for the refinement of a corner, in reaches: its own corners are within the squares
    too."""
    least_window_px: int = 2  # least half side, px: five pixels contain an edge in focus
    most_window_px: int = 20  # largest half side, px: the time increases with the window's area
    smoothing_px: float = 0.8  # sigma of the blur before the refinement, px: about that of a lens in focus
    cut_off: float = 0.3  # distance of the clipping levels from the middle grey level, as a fraction of the contrast
    passes: int = 100  # most passes of the refinement
    settled_px: float = 1e-4  # change of a corner that ends the refinement, px


def remove_doubtful(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Remove corners (J, I, 2) that differ from their neighbours or are not between four squares."""
    grid = grid.copy()
    there = np.argwhere(np.isfinite(grid[..., 0]))
    grid[tuple(np.delete(there, select_agreeing(grid[tuple(there.T)], there), axis=0).T)] = np.nan
    grid[_compare_squares(grey, grid)[1] == 0] = np.nan
    return grid


def find_chessboard_fault(grey: np.ndarray, board: np.ndarray) -> str | None:
    """Return why corners (rows, columns, 2) are not those of a chessboard in an image (H, W), or None.

    Every part of it must be an even grid in perspective; over the whole board, the lens may bend its lines.
    Neighbouring squares must be dark and bright in turn. The pattern must not continue beyond the board, except by
    squares that its rim cuts. Missing corners are NaN.
    """
    rows, columns = board.shape[:2]
    share = _measure_unevenness(board)
    if share is None:
        return "too few corners are in view"
    if not share < _Rule.residual:
        return f"its corners deviate from an even grid by {100 * share:.0f} % of a square"
    centres = (board[:-1, :-1] + board[1:, 1:] + board[:-1, 1:] + board[1:, :-1]) / 4
    known = np.isfinite(centres[..., 0])
    levels = np.full(known.shape, np.nan)
    levels[known] = sample_levels(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _Rule.sigma_px), centres[known])
    sign = np.where(np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2, -1.0, 1.0)
    changes = [np.diff(levels, axis=axis) * (sign[1:] if axis == 0 else sign[:, 1:]) for axis in (0, 1)]
    turns = np.concatenate([each[np.isfinite(each)] for each in changes])
    if len(turns) and (np.sign(turns) == np.sign(np.median(turns))).mean() < _Rule.alternating:
        return "its squares are not dark and bright in turn"
    return f"the board has more corners than {columns} x {rows}" if has_more_corners(grey, board) else None


def _measure_unevenness(board: np.ndarray) -> float | None:
    """Return the rms distance of corners (rows, columns, 2) from even grids in perspective, in side lengths.

    Each grid is a homography of a part of the board. None if no part has enough corners.
    """
    size, square, freedom = _Rule.neighbourhood, 0.0, 0
    starts = [range(0, max(length - size, 0) + 1) for length in board.shape[:2]]
    for top, left in product(*starts):
        part = board[top : top + size, left : left + size]
        j, i = np.nonzero(np.isfinite(part[..., 0]))
        sides = _measure_sides(part)
        if min(len(set(i)), len(set(j))) < 2 or len(i) < 6 or not len(sides):
            continue
        flat, pixels = np.stack([i, j], axis=1).astype(np.float64), part[j, i]
        homography = cv2.findHomography(flat, pixels)[0]
        if homography is None:
            continue
        off = (pixels - cv2.perspectiveTransform(flat[:, None], homography)[:, 0]) / np.median(sides)
        square, freedom = square + float(np.sum(off**2)), freedom + 2 * len(i) - 8
    return float(np.sqrt(2.0 * square / freedom)) if freedom else None


def has_more_corners(grey: np.ndarray, board: np.ndarray) -> bool:
    """Return True if a pattern continues beyond the sides of a board (rows, columns, 2).

    Squares at the rim that are cut do not count, if all sides in view show which corners are meant: beyond each of
    them there are such squares too, or whole ones and no more.
    """
    usual = np.median(_compare_squares(grey, board)[1][np.isfinite(board[..., 0])])
    continues, ends = np.zeros(4, bool), np.zeros(4, bool)
    for turn in range(4):
        turned = np.rot90(board, turn)
        next_row = _extrapolate_row(turned[:3])[None]
        inside = np.all((next_row > 0) & (next_row < np.array(grey.shape[::-1]) - 1), axis=2)[0]
        further = _compare_squares(grey, np.concatenate([next_row, turned]))[1][0]
        continues[turn] = inside.sum() > 2 and (further[inside] > usual / 2).mean() > 0.5
        if continues[turn] and _check_whole(grey, next_row[0], turned[0]):
            return True
        ends[turn] = inside.mean() > 0.5 and not continues[turn] and not _check_whole(grey, turned[0], turned[1])
    return bool(continues.any() and ends.any())


def _extrapolate_row(rows: np.ndarray) -> np.ndarray:
    """Return the places (K, 2) before two or three rows of corners (R, K, 2) at even distances in perspective.

    Let r be the ratio of the last two distances along a line in perspective. By the cross ratio of evenly spaced
    points, the ratio of the next distance to the last one is (1 + r) / (3 - r).
    """
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=2)
    known = np.isfinite(steps).all(axis=0)
    ratio = float(np.median(steps[0, known] / steps[1, known])) if len(steps) > 1 and known.any() else 1.0
    return rows[0] + (1.0 + ratio) / (3.0 - ratio) * (rows[0] - rows[1])


def _check_whole(grey: np.ndarray, corners: np.ndarray, before: np.ndarray) -> bool:
    """Return True if the squares beyond a row of corners (K, 2) alternate over their whole width."""
    near, far = (
        _measure_alternation(grey, corners + reach * (corners - before)) for reach in (_Rule.reaches[-1], _Rule.far)
    )
    return bool(far > near / 2)


def _measure_alternation(grey: np.ndarray, places: np.ndarray) -> float:
    """Return the mean change of grey level, with alternating sign, along the middles of places (K, 2); 0 if unknown."""
    middles = (places[1:] + places[:-1]) / 2
    inside = np.isfinite(middles[:, 0]) & ((middles > 0) & (middles < np.array(grey.shape[::-1]) - 1)).all(axis=1)
    levels = np.full(len(middles), np.nan)
    levels[inside] = sample_levels(grey, middles[inside])
    changes = np.diff(levels) * np.where(np.arange(len(levels) - 1) % 2, -1.0, 1.0)
    known = changes[np.isfinite(changes)]
    return float(abs(known.mean())) if len(known) else 0.0


def refine_corners(image: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Move corners (J, I, 2) to the saddle points of the grey levels (H, W), in windows within the adjacent squares.

    Grey levels are clipped near the middle between dark and bright, so that only the edges of the squares count, not
    lighting and noise inside them. Corners that leave their window, or are not between four squares, become NaN.
    """
    found, sides = np.full_like(grid, np.nan), _measure_sides(grid)
    if not len(sides):
        return found
    most = int(np.clip(_Rule.window * _Rule.reaches[0] * sides.min(), _Rule.least_window_px, _Rule.most_window_px))
    rim = most + 3
    until = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _Rule.passes, _Rule.settled_px
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _Rule.smoothing_px)
    levels, _, reaches = _compare_squares(smooth, grid)
    dark, bright = np.sort((levels[:2] + levels[2:]) / 2, axis=0)
    smooth = cv2.copyMakeBorder(smooth, rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    for place in np.argwhere(bright > dark):
        at = tuple(place)
        half = int(np.clip(_Rule.window * reaches[at] * sides.min(), _Rule.least_window_px, most))
        column, row = nearest = np.rint(grid[at]).astype(int)
        window = smooth[row : row + 2 * rim + 1, column : column + 2 * rim + 1]
        middle, span = (dark[at] + bright[at]) / 2, _Rule.cut_off * (bright[at] - dark[at])
        edges = np.clip((window - middle) / span, -1.0, 1.0).astype(np.float32)
        start = (grid[at] - nearest + rim).astype(np.float32).reshape(1, 1, 2)
        moved = cv2.cornerSubPix(edges, start.copy(), (half, half), (-1, -1), until)
        if np.abs(moved - start).max() < half:
            found[at] = moved[0, 0] - rim + nearest
    return remove_doubtful(smooth[rim:-rim, rim:-rim], found)


def _measure_sides(grid: np.ndarray) -> np.ndarray:
    """Return the lengths (N,) in px of all sides of squares with two known corners."""
    lengths = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)])
    return lengths[np.isfinite(lengths)]


def count_corners(board: np.ndarray) -> int:
    """Count the known corners of a board (rows, columns, 2)."""
    return int(np.isfinite(board[..., 0]).sum())


def _compare_squares(grey: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return levels (4, J, I) of the four squares around each corner, their contrast (J, I), and the reach (J, I).

    Levels are in cyclic order, NaN if unknown. The contrast is the difference of the dark and the bright squares. It is
    zero if opposite squares differ at every reach, as at a board's outline or below a stripe, and if squares are
    unknown. The reach is the first one where opposite squares are equal.
    """
    down, right = (_measure_steps(grid, axis) for axis in (0, 1))
    levels, contrast = np.full((4, *grid.shape[:2]), np.nan), np.zeros(grid.shape[:2])
    reaches = np.full(grid.shape[:2], _Rule.reaches[0])
    known = np.isfinite(grid + down + right).all(axis=2)
    at, along, across = grid[known], right[known], down[known]
    for reach in _Rule.reaches:
        places = [at + reach * (x * along + y * across) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        here = np.full_like(levels, np.nan)
        here[:, known] = sample_levels(grey, np.concatenate(places)).reshape(4, -1)
        difference = np.abs(here[0] + here[2] - here[1] - here[3]) / 2
        unlike = np.maximum(np.abs(here[0] - here[2]), np.abs(here[1] - here[3]))
        matching = (contrast == 0) & (unlike < _Rule.unlike * difference)
        levels = np.where(matching | (reach == _Rule.reaches[0]), here, levels)
        contrast, reaches = np.where(matching, difference, contrast), np.where(matching, reach, reaches)
    return levels, contrast, reaches


def _measure_steps(grid: np.ndarray, axis: int) -> np.ndarray:
    """Return steps (J, I, 2) between corners along an axis: the mean of both sides, or the known one."""
    ways = np.diff(grid, axis=axis)
    none = np.full_like(np.take(grid, [0], axis=axis), np.nan)
    before, after = np.concatenate([none, ways], axis=axis), np.concatenate([ways, none], axis=axis)
    return np.where(np.isnan(before), after, np.where(np.isnan(after), before, (before + after) / 2))


def sample_levels(grey: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return grey levels (N,) interpolated at places (N, 2); outside the image those of its border."""
    return map_coordinates(grey, places.T[::-1], output=float, order=1, mode="nearest")


HALF_WINDOW = 5  # half side of the window for a corner's quality, px


def convert_to_eight_bit(image):
    """Return the image (H, W) as uint8, scaled to its maximum if it has 16 bit; raise `ImageError` for others."""
    if check_grey(image).dtype == np.uint8:
        return image
    return np.rint(image * (255.0 / max(int(image.max()), 1))).astype(np.uint8)


def measure_corners(image, pixels):
    """Measure contrast and sharpness (N,), as in `TargetView`, of corners (N, 2) of two bright and two dark fields."""
    rim = HALF_WINDOW + 1
    grey = cv2.copyMakeBorder(image.astype(np.float32), rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    span = np.arange(-HALF_WINDOW, HALF_WINDOW + 1) + HALF_WINDOW + 1
    centre = np.rint(pixels).astype(int)
    rows, columns = centre[:, 1, None, None] + span[:, None], centre[:, 0, None, None] + span
    # Half the pixels of the window are bright, half are dark: their standard deviation is half the contrast.
    contrast = 2 * grey[rows, columns].std((1, 2), dtype=np.float64)
    steepest = slope[rows, columns].max((1, 2)).astype(np.float64)
    return {"contrast": contrast, "sharpness": steepest / np.maximum(contrast, 1e-9)}
