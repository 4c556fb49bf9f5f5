"""A chessboard's corners as a grid, an array (rows, columns, 2) of pixels with NaN for those that are not seen."""

import cv2
import numpy as np

from uwlts.targets.detection.lattice import agreeing

_SIGMA = 1.5  # blur before squares are compared, px
_LARGEST_RESIDUAL = 1 / 30  # of a square's side, rms
_ALTERNATING = 0.9  # share of neighbouring squares of which the one that should be is the darker
_IN_SQUARE = 0.3  # side lengths from a corner at which the squares around it are sampled: clear of its edges
_UNLIKE = 0.6  # most difference between opposite squares, as a share of that between dark and bright ones
_WINDOW_SHARE = (
    0.3  # of a square's side: half the side of the window in which a corner is refined, clear of the next one
)
_LEAST_WINDOW = 2  # px, half a side: five pixels across hold an edge in focus
_LARGEST_WINDOW = 20  # px, half a side, as time grows with the window's area
_SMOOTHING = 0.8  # px, sigma of the blur before refinement, about that of a lens in focus
_CUT_OFF = 0.3  # share of the contrast on either side of the middle level from which levels are taken as even
_REFINEMENT = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)  # most passes, and px at which they end


def without_doubtful(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Corners (J, I, 2) without those that differ from their neighbours or do not lie between four squares."""
    grid = grid.copy()
    there = np.argwhere(np.isfinite(grid[..., 0]))
    doubtful = np.delete(there, agreeing(grid[tuple(there.T)], there), axis=0)
    grid[tuple(doubtful.T)] = np.nan
    grid[_square_contrast(grey, grid) == 0] = np.nan
    return grid


def why_no_chessboard(grey: np.ndarray, board: np.ndarray) -> str | None:
    """What speaks against corners (rows, columns, 2), NaN where unknown, as those of a chessboard in an image (H, W).

    A homography and a cubic for the lens's distortion must leave less than a thirtieth of a square, and neighbouring
    squares must be dark and bright in turn, and not go on beyond its sides. None where nothing does.
    """
    rows, columns = board.shape[:2]
    there = np.isfinite(board[..., 0])
    j, i = np.nonzero(there)
    flat, pixels = np.stack([i, j], axis=1).astype(np.float64), board[there]
    sides, several = _sides(board), min(len(set(i)), len(set(j))) > 1 and len(flat) > 5
    homography = cv2.findHomography(flat, pixels)[0] if several and len(sides) else None
    if homography is None:
        return "too few corners are seen"
    off = pixels - cv2.perspectiveTransform(flat[:, None], homography)[:, 0]
    x, y = (2.0 * flat / (columns - 1, rows - 1) - 1.0).T
    terms = np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)
    if len(flat) > 2 * terms.shape[1]:
        off = off - terms @ np.linalg.lstsq(terms, off, rcond=None)[0]
    share = np.sqrt(np.mean(np.sum(off**2, axis=1))) / np.median(sides)
    if not share < _LARGEST_RESIDUAL:
        return f"its corners lie {100 * share:.0f} % of a square off an even grid"
    centres = (board[:-1, :-1] + board[1:, 1:] + board[:-1, 1:] + board[1:, :-1]) / 4
    known = np.isfinite(centres[..., 0])
    levels = np.full(known.shape, np.nan)
    levels[known] = levels_at(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SIGMA), centres[known])
    sign = np.where(np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2, -1.0, 1.0)
    changes = [np.diff(levels, axis=axis) * (sign[1:] if axis == 0 else sign[:, 1:]) for axis in (0, 1)]
    turns = np.concatenate([each[np.isfinite(each)] for each in changes])
    if len(turns) and (np.sign(turns) == np.sign(np.median(turns))).mean() < _ALTERNATING:
        return "its squares are not dark and bright in turn"
    if _goes_on(grey, board):
        return f"the board has more corners than {columns} x {rows}"
    return None


def _goes_on(grey: np.ndarray, board: np.ndarray) -> bool:
    """Whether the pattern goes on beyond a side of a board (rows, columns, 2)."""
    usual = np.median(_square_contrast(grey, board)[np.isfinite(board[..., 0])])
    for turn in range(4):
        turned = np.rot90(board, turn)
        next_row = 2.0 * turned[:1] - turned[1:2]
        inside = np.all((next_row > 0) & (next_row < np.array(grey.shape[::-1]) - 1), axis=2)[0]
        further = _square_contrast(grey, np.concatenate([next_row, turned]))[0]
        if inside.sum() > 2 and (further[inside] > usual / 2).mean() > 0.5:
            return True
    return False


def refined(image: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Corners (J, I, 2) moved to the saddles of the grey levels (H, W), in windows that stay within the squares around.

    Grey levels are cut off near the middle between dark and bright, so that only the squares' edges count, not what
    light and noise do within them. Corners that leave the window, or do not lie between four squares, are NaN.
    """
    found, sides = np.full_like(grid, np.nan), _sides(grid)
    if not len(sides):
        return found
    half = int(np.clip(_WINDOW_SHARE * sides.min(), _LEAST_WINDOW, _LARGEST_WINDOW))
    rim = half + 3
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SMOOTHING)
    levels = _square_levels(smooth, grid)
    dark, bright = np.sort((levels[:2] + levels[2:]) / 2, axis=0)
    smooth = cv2.copyMakeBorder(smooth, rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    for place in np.argwhere(bright > dark):
        at = tuple(place)
        column, row = nearest = np.rint(grid[at]).astype(int)
        window = smooth[row : row + 2 * rim + 1, column : column + 2 * rim + 1]
        middle, span = (dark[at] + bright[at]) / 2, _CUT_OFF * (bright[at] - dark[at])
        edges = np.clip((window - middle) / span, -1.0, 1.0).astype(np.float32)
        start = (grid[at] - nearest + rim).astype(np.float32).reshape(1, 1, 2)
        moved = cv2.cornerSubPix(edges, start.copy(), (half, half), (-1, -1), _REFINEMENT)
        if np.abs(moved - start).max() < half:
            found[at] = moved[0, 0] - rim + nearest
    return without_doubtful(smooth[rim:-rim, rim:-rim], found)


def _sides(grid: np.ndarray) -> np.ndarray:
    """Lengths (N,) of all sides of squares of which both corners are seen, px."""
    lengths = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)])
    return lengths[np.isfinite(lengths)]


def count_seen(board: np.ndarray) -> int:
    """Number of corners that are seen, of a board (rows, columns, 2) with NaN for the others."""
    return int(np.isfinite(board[..., 0]).sum())


def _square_levels(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Grey levels (4, J, I) of the squares around each corner, one after the other; NaN where they are not known."""
    down, right = (_steps(grid, axis) for axis in (0, 1))
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    places = np.stack([grid + _IN_SQUARE * (x * right + y * down) for x, y in signs])
    known = np.isfinite(places).all(axis=(0, 3))
    levels = np.full(places.shape[:3], np.nan)
    levels[:, known] = levels_at(grey, places[:, known].reshape(-1, 2)).reshape(4, -1)
    return levels


def _square_contrast(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Difference (J, I) between the dark and the bright squares around a corner.

    Zero where opposite ones are unlike, as on a board's rim or where a stripe crosses, and where nothing is known.
    """
    levels = _square_levels(grey, grid)
    difference = np.abs(levels[0] + levels[2] - levels[1] - levels[3]) / 2
    unlike = np.maximum(np.abs(levels[0] - levels[2]), np.abs(levels[1] - levels[3]))
    return np.where(unlike < _UNLIKE * difference, difference, 0.0)


def _steps(grid: np.ndarray, axis: int) -> np.ndarray:
    """Steps (J, I, 2) from one corner to the next: the mean of those on both sides, or the one that is there."""
    ways = np.diff(grid, axis=axis)
    none = np.full_like(np.take(grid, [0], axis=axis), np.nan)
    before, after = np.concatenate([none, ways], axis=axis), np.concatenate([ways, none], axis=axis)
    return np.where(np.isnan(before), after, np.where(np.isnan(after), before, (before + after) / 2))


def levels_at(grey: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Grey levels (N,) at places (N, 2) between pixels; those of the rim beyond it."""
    x, y = np.clip(places, 0.0, np.array(grey.shape[::-1]) - 1.0).T
    column, row = (np.minimum(each.astype(int), size - 2) for each, size in ((x, grey.shape[1]), (y, grey.shape[0])))
    dx, dy = x - column, y - row
    upper = grey[row, column] * (1 - dx) + grey[row, column + 1] * dx
    return upper * (1 - dy) + (grey[row + 1, column] * (1 - dx) + grey[row + 1, column + 1] * dx) * dy
