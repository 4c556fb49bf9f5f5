"""Grid of a chessboard's corners: an array (rows, columns, 2) of pixels with NaN for missing corners."""

from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.targets.detection.lattice import select_agreeing


@dataclass(frozen=True, kw_only=True)
class GridRule:
    """Numbers of the refinement and check of a chessboard's corners.

    Chosen by hand with the reasons below, not fitted to data. Results with these numbers are checked on the drawn
    boards of tests/uwlts/targets and on real photographs (tests/system/test_real_images.py).

    Attributes
    ----------
    sigma_px : float
        Blur before squares are compared, px.
    residual : float
        Largest rms distance of the corners from an even grid, in side lengths of a square.
    alternating : float
        Least fraction of neighbouring squares that are dark and bright as expected.
    sample_offset : float
        Distance of the sampled places in squares from their corner, in side lengths: away from the edges.
    unlike : float
        Largest difference between opposite squares, as a fraction of that between dark and bright squares.
    window : float
        Half side of the window for the refinement of a corner, in side lengths: without the next corner.
    least_window_px : int
        Least half side, px: five pixels contain an edge in focus.
    most_window_px : int
        Largest half side, px: the time increases with the window's area.
    smoothing_px : float
        Sigma of the blur before the refinement, px: about that of a lens in focus.
    cut_off : float
        Distance of the clipping levels from the middle grey level, as a fraction of the contrast.
    passes : int
        Most passes of the refinement.
    settled_px : float
        Change of a corner that ends the refinement, px.
    """

    sigma_px: float = 1.5
    residual: float = 1 / 30
    alternating: float = 0.9
    sample_offset: float = 0.3
    unlike: float = 0.6
    window: float = 0.3
    least_window_px: int = 2
    most_window_px: int = 20
    smoothing_px: float = 0.8
    cut_off: float = 0.3
    passes: int = 100
    settled_px: float = 1e-4


_RULE = GridRule()


def remove_doubtful(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Remove corners (J, I, 2) that differ from their neighbours or are not between four squares."""
    grid = grid.copy()
    there = np.argwhere(np.isfinite(grid[..., 0]))
    doubtful = np.delete(there, select_agreeing(grid[tuple(there.T)], there), axis=0)
    grid[tuple(doubtful.T)] = np.nan
    grid[_square_contrast(grey, grid) == 0] = np.nan
    return grid


def find_chessboard_fault(grey: np.ndarray, board: np.ndarray) -> str | None:
    """Return why corners (rows, columns, 2) are not those of a chessboard in an image (H, W), or None.

    The residual of a homography and a cubic for the lens distortion must be small. Neighbouring squares must be dark
    and bright in turn, and the pattern must not continue beyond the board. Missing corners are NaN.
    """
    rows, columns = board.shape[:2]
    there = np.isfinite(board[..., 0])
    j, i = np.nonzero(there)
    flat, pixels = np.stack([i, j], axis=1).astype(np.float64), board[there]
    sides, several = _side_lengths(board), min(len(set(i)), len(set(j))) > 1 and len(flat) > 5
    homography = cv2.findHomography(flat, pixels)[0] if several and len(sides) else None
    if homography is None:
        return "too few corners are in view"
    off = pixels - cv2.perspectiveTransform(flat[:, None], homography)[:, 0]
    x, y = (2.0 * flat / (columns - 1, rows - 1) - 1.0).T
    terms = np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)
    if len(flat) > 2 * terms.shape[1]:
        off = off - terms @ np.linalg.lstsq(terms, off, rcond=None)[0]
    share = np.sqrt(np.mean(np.sum(off**2, axis=1))) / np.median(sides)
    if not share < _RULE.residual:
        return f"its corners deviate from an even grid by {100 * share:.0f} % of a square"
    centres = (board[:-1, :-1] + board[1:, 1:] + board[:-1, 1:] + board[1:, :-1]) / 4
    known = np.isfinite(centres[..., 0])
    levels = np.full(known.shape, np.nan)
    levels[known] = sample_levels(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _RULE.sigma_px), centres[known])
    sign = np.where(np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2, -1.0, 1.0)
    changes = [np.diff(levels, axis=axis) * (sign[1:] if axis == 0 else sign[:, 1:]) for axis in (0, 1)]
    turns = np.concatenate([each[np.isfinite(each)] for each in changes])
    if len(turns) and (np.sign(turns) == np.sign(np.median(turns))).mean() < _RULE.alternating:
        return "its squares are not dark and bright in turn"
    if _has_more_corners(grey, board):
        return f"the board has more corners than {columns} x {rows}"
    return None


def _has_more_corners(grey: np.ndarray, board: np.ndarray) -> bool:
    """Return True if the pattern continues beyond a side of a board (rows, columns, 2)."""
    usual = np.median(_square_contrast(grey, board)[np.isfinite(board[..., 0])])
    for turn in range(4):
        turned = np.rot90(board, turn)
        next_row = 2.0 * turned[:1] - turned[1:2]
        inside = np.all((next_row > 0) & (next_row < np.array(grey.shape[::-1]) - 1), axis=2)[0]
        further = _square_contrast(grey, np.concatenate([next_row, turned]))[0]
        if inside.sum() > 2 and (further[inside] > usual / 2).mean() > 0.5:
            return True
    return False


def refine_corners(image: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Move corners (J, I, 2) to the saddle points of the grey levels (H, W), in windows within the adjacent squares.

    Grey levels are clipped near the middle between dark and bright, so that only the edges of the squares count, not
    lighting and noise inside them. Corners that leave their window, or are not between four squares, become NaN.
    """
    found, sides = np.full_like(grid, np.nan), _side_lengths(grid)
    if not len(sides):
        return found
    half = int(np.clip(_RULE.window * sides.min(), _RULE.least_window_px, _RULE.most_window_px))
    rim = half + 3
    until = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _RULE.passes, _RULE.settled_px
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _RULE.smoothing_px)
    levels = _square_levels(smooth, grid)
    dark, bright = np.sort((levels[:2] + levels[2:]) / 2, axis=0)
    smooth = cv2.copyMakeBorder(smooth, rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    for place in np.argwhere(bright > dark):
        at = tuple(place)
        column, row = nearest = np.rint(grid[at]).astype(int)
        window = smooth[row : row + 2 * rim + 1, column : column + 2 * rim + 1]
        middle, span = (dark[at] + bright[at]) / 2, _RULE.cut_off * (bright[at] - dark[at])
        edges = np.clip((window - middle) / span, -1.0, 1.0).astype(np.float32)
        start = (grid[at] - nearest + rim).astype(np.float32).reshape(1, 1, 2)
        moved = cv2.cornerSubPix(edges, start.copy(), (half, half), (-1, -1), until)
        if np.abs(moved - start).max() < half:
            found[at] = moved[0, 0] - rim + nearest
    return remove_doubtful(smooth[rim:-rim, rim:-rim], found)


def _side_lengths(grid: np.ndarray) -> np.ndarray:
    """Return the lengths (N,) in px of all sides of squares with two known corners."""
    lengths = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)])
    return lengths[np.isfinite(lengths)]


def count_corners(board: np.ndarray) -> int:
    """Count the known corners of a board (rows, columns, 2)."""
    return int(np.isfinite(board[..., 0]).sum())


def _square_levels(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return grey levels (4, J, I) of the four squares around each corner, in cyclic order; NaN if unknown."""
    down, right = (_steps(grid, axis) for axis in (0, 1))
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    places = np.stack([grid + _RULE.sample_offset * (x * right + y * down) for x, y in signs])
    known = np.isfinite(places).all(axis=(0, 3))
    levels = np.full(places.shape[:3], np.nan)
    levels[:, known] = sample_levels(grey, places[:, known].reshape(-1, 2)).reshape(4, -1)
    return levels


def _square_contrast(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the difference (J, I) between the dark and the bright squares around each corner.

    It is zero if opposite squares differ, as at a board's rim or below a stripe, and if squares are unknown.
    """
    levels = _square_levels(grey, grid)
    difference = np.abs(levels[0] + levels[2] - levels[1] - levels[3]) / 2
    unlike = np.maximum(np.abs(levels[0] - levels[2]), np.abs(levels[1] - levels[3]))
    return np.where(unlike < _RULE.unlike * difference, difference, 0.0)


def _steps(grid: np.ndarray, axis: int) -> np.ndarray:
    """Return steps (J, I, 2) between corners along an axis: the mean of both sides, or the known one."""
    ways = np.diff(grid, axis=axis)
    none = np.full_like(np.take(grid, [0], axis=axis), np.nan)
    before, after = np.concatenate([none, ways], axis=axis), np.concatenate([ways, none], axis=axis)
    return np.where(np.isnan(before), after, np.where(np.isnan(after), before, (before + after) / 2))


def sample_levels(grey: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return grey levels (N,) interpolated at places (N, 2); outside the image those of its border."""
    x, y = np.clip(places, 0.0, np.array(grey.shape[::-1]) - 1.0).T
    column, row = (np.minimum(each.astype(int), size - 2) for each, size in ((x, grey.shape[1]), (y, grey.shape[0])))
    dx, dy = x - column, y - row
    upper = grey[row, column] * (1 - dx) + grey[row, column + 1] * dx
    return upper * (1 - dy) + (grey[row + 1, column] * (1 - dx) + grey[row + 1, column + 1] * dx) * dy
