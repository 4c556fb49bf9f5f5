"""Corners of a chessboard seen completely or in part: a lattice grown over saddle points of the grey levels."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from scipy.spatial import KDTree

from uwlts.targets.detection.chessboard_grid import count_corners, has_more_corners, remove_doubtful, sample_levels
from uwlts.targets.detection.lattice import grow_lattice


class _Rule:
    """Numbers of the search for a chessboard. Pixels are those of the scaled image.

    Chosen by hand with the reasons below, not fitted to data. Results with these numbers are checked on the drawn
    boards of tests/uwlts/targets and on real photographs (tests/system/test_real_images.py).
    """

    scales: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Scales of the image: in a blurred or large image, corners are sharper at a smaller scale."""
    sigma_px: float = 1.5  # blur before derivatives, px
    ring_px: float = 6.0  # radius of the circle around a corner, px: within squares of more than 6 px
    inner_ring: float = 0.6  # radius of a second circle, as a fraction of the first one
    ring_places: int = 24  # places on a circle: one every 1.6 px
    two_fold: float = 0.7
    """Least fraction of the variation around a corner that has two periods per turn, as from two dark and two bright
    sectors."""
    in_phase: float = 0.9  # least cosine of the phase between both circles: the edges of the sectors are radial
    contrast: float = 2.0  # least contrast around a corner, grey levels: above rounding
    edge_contrast: float = 0.4  # least contrast of an edge between neighbours, as a fraction of theirs
    edge_offset: float = 0.12
    """Distance of samples from an edge, in lengths of the edge: beyond the blur, within the squares."""
    edge_places: tuple[float, ...] = (0.25, 0.5, 0.75)  # sampled places along an edge, in lengths of the edge
    contrast_ratio: float = 4.0  # largest ratio of the contrasts of neighbours
    opposite: float = -0.5  # largest cosine between the phases of neighbours, which are opposite except for perspective
    neighbours: int = 24  # nearest corners that contain the neighbours: two rings of a square lattice
    most_seeds: int = 40  # most seeds that are tried, corners with the clearest edges first
    seed_sine: float = 0.3  # least sine of the angle between both edges of a seed
    rim_px: float = 6.0  # least distance of a certainly found corner from the image border, px, minus `ring_px`


@dataclass(frozen=True)
class _Corners:
    """Candidates for corners in an image."""

    pixels: np.ndarray  # (N, 2)
    contrast: np.ndarray  # (N,); contrast of the sectors around each candidate, grey levels
    phase: np.ndarray  # (N,); orientation of the sectors, rad
    grey: np.ndarray  # (H, W) float32; blurred image

    @classmethod
    def from_image(cls, image: np.ndarray) -> "_Corners":
        """Find the candidates in an image (H, W)."""
        grey = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _Rule.sigma_px)
        along_x, along_y = (cv2.Scharr(grey, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
        xx, xy = (cv2.Scharr(along_x, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
        saddle = np.maximum(xy * xy - xx * cv2.Scharr(along_y, cv2.CV_32F, 0, 1), 0.0)
        side = 2 * int(np.ceil(2 * _Rule.sigma_px)) + 1
        highest = (saddle == cv2.dilate(saddle, np.ones((side, side)))) & (saddle > 0)
        rim = int(_Rule.ring_px) + 2
        highest[:rim], highest[-rim:], highest[:, :rim], highest[:, -rim:] = False, False, False, False
        pixels = np.argwhere(highest)[:, ::-1].astype(np.float64)
        outer = _compute_harmonics(grey, pixels, _Rule.ring_px)
        inner = _compute_harmonics(grey, pixels, _Rule.inner_ring * _Rule.ring_px)
        power = np.abs(outer[:, 1:]) ** 2
        share = power[:, 1] / np.maximum(power.sum(axis=1), 1e-9)
        in_phase = np.cos(np.angle(outer[:, 2]) - np.angle(inner[:, 2]))
        contrast = 2.0 * np.abs(outer[:, 2])
        good = (share > _Rule.two_fold) & (in_phase > _Rule.in_phase) & (contrast > _Rule.contrast)
        return cls(pixels[good], contrast[good], np.angle(outer[good, 2]), grey)

    def measure_edges(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the signed contrast (K,) of the edges between corners (K,), relative to the corners' smaller contrast.

        The contrast is the least difference of grey levels between both sides. It is zero if its sign changes along the
        edge, or if the sectors do not fit neighbouring corners.
        """
        at, way = self.pixels[start], self.pixels[end] - self.pixels[start]
        across = _Rule.edge_offset * np.stack([-way[:, 1], way[:, 0]], axis=1)
        places = [at + share * way for share in _Rule.edge_places]
        steps = np.stack(
            [sample_levels(self.grey, each + across) - sample_levels(self.grey, each - across) for each in places]
        )
        contrasts = self.contrast[[start, end]]
        neighbours = (np.sign(steps) == np.sign(steps[0])).all(axis=0)
        neighbours &= contrasts.max(axis=0) < _Rule.contrast_ratio * contrasts.min(axis=0)
        neighbours &= np.cos(self.phase[start] - self.phase[end]) < _Rule.opposite
        return np.where(neighbours, np.sign(steps[0]) * np.abs(steps).min(axis=0) / contrasts.min(axis=0), 0.0)

    def find_seeds(self, tree: KDTree) -> Iterator[tuple[int, np.ndarray]]:
        """Yield corners with edges along two axes, and the steps (2, 2) along these; the clearest corners first."""
        ends = np.asarray(tree.query(self.pixels, k=min(_Rule.neighbours + 1, len(self.pixels)))[1])[:, 1:]
        starts = np.repeat(np.arange(len(ends)), ends.shape[1])
        edges = self.measure_edges(starts, ends.ravel()).reshape(ends.shape)
        sides = [sign * edges > _Rule.edge_contrast for sign in (1, -1)]
        number = np.sum([side.sum(axis=1).clip(max=2) for side in sides], axis=0)
        both = np.flatnonzero(sides[0].any(axis=1) & sides[1].any(axis=1))
        for corner in sorted(both.tolist(), key=lambda c: (-number[c], -self.contrast[c])):
            first, second = (self.pixels[ends[corner, side[corner].argmax()]] - self.pixels[corner] for side in sides)
            turn = first[0] * second[1] - first[1] * second[0]
            if abs(turn) > _Rule.seed_sine * np.linalg.norm(first) * np.linalg.norm(second):
                yield corner, np.stack([first, second] if turn > 0 else [second, first])

    def may_be_neighbours(self, corner: int, other: int, reach: int) -> bool:
        """Return True if a step of one or two may connect two corners in the lattice."""
        if reach == 1:
            return bool(abs(self.measure_edges(np.array([corner]), np.array([other]))[0]) > _Rule.edge_contrast)
        contrasts = self.contrast[[corner, other]]
        same_phase = np.cos(self.phase[corner] - self.phase[other]) > -_Rule.opposite
        return bool(same_phase and contrasts.max() < _Rule.contrast_ratio * contrasts.min())


def find_board(grey: np.ndarray, columns: int, rows: int) -> np.ndarray | None:
    """Find the corners (rows, columns, 2) of a board in a grey image (H, W), with NaN for missing corners.

    If the board is partly outside the image, corners are numbered from the sides inside it. Returns None if there is no
    board or if its place is ambiguous. Corners have an accuracy of about a pixel. The board may be rotated by half a
    turn.
    """
    best = None
    for scale in _Rule.scales:
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
        if min(small.shape) < 8 * _Rule.ring_px:
            break
        corners = _Corners.from_image(small)
        board = _complete_board(_find_piece(corners, columns * rows), columns, rows, corners.grey)
        if board is not None and (best is None or count_corners(board) > count_corners(best)):
            best = (board + 0.5) / scale - 0.5
        if best is not None and count_corners(best) == columns * rows:
            break
    return best


def find_largest_piece(grey: np.ndarray) -> np.ndarray:
    """Return corners (J, I, 2) of the largest piece of any board in a grey image (H, W), NaN where they are missing."""
    return _find_piece(_Corners.from_image(grey), math.inf)


def _find_piece(corners: _Corners, most: float) -> np.ndarray:
    """Return the largest piece (J, I, 2) that grows from the seeds, or the first one of ``most`` corners."""
    if len(corners.pixels) < 4:
        return np.empty((0, 0, 2))
    tree, tried, found = KDTree(corners.pixels), set(), {}
    for number, (seed, steps) in enumerate(corners.find_seeds(tree)):
        if number >= _Rule.most_seeds or len(found) >= most:
            break
        if seed not in tried:
            same = corners.may_be_neighbours
            piece = grow_lattice(seed, steps, corners.pixels, tree, nearest=4, may_be_neighbours=same)
            tried.update(piece.values())
            found = max(found, piece, key=len)
    return _arrange_piece(found, corners)


def _arrange_piece(places: dict[tuple[int, int], int], corners: _Corners) -> np.ndarray:
    """Return corners (J, I, 2) in their places, with NaN for missing corners and after `remove_doubtful`."""
    indices, pixels = np.array(list(places)).reshape(-1, 2), corners.pixels[list(places.values())]
    if len(indices) == 0:
        return np.empty((0, 0, 2))
    indices = indices - indices.min(axis=0)
    piece = np.full((*(indices.max(axis=0) + 1)[::-1], 2), np.nan)
    piece[indices[:, 1], indices[:, 0]] = pixels
    return _trim(remove_doubtful(corners.grey, piece))


def _trim(piece: np.ndarray) -> np.ndarray:
    """Remove empty rows and columns around the piece."""
    there = np.isfinite(piece[..., 0])
    if not there.any():
        return np.empty((0, 0, 2))
    down, right = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    return piece[down[0] : down[-1] + 1, right[0] : right[-1] + 1]


def _complete_board(piece: np.ndarray, columns: int, rows: int, grey: np.ndarray) -> np.ndarray | None:
    """Return the board (rows, columns, 2) that contains a piece (J, I, 2); None if its place is ambiguous."""
    boards = []
    for turned in (piece, np.rot90(piece)):
        if turned.size:
            board = _place_piece(_crop_to_board(turned, columns, rows, grey), columns, rows, grey.shape)
            boards += [] if board is None else [board]
    # A piece that fits in both orientations may have further corners in one of them.
    boards = [board for board in boards if not has_more_corners(grey, board)] or boards
    counts = [count_corners(board) for board in boards]
    whole = counts.count(rows * columns)
    if len(boards) == 2 and (whole == 0 or (whole == 2 and rows != columns)):
        return None
    return boards[int(np.argmax(counts))] if boards else None


def _crop_to_board(piece: np.ndarray, columns: int, rows: int, grey: np.ndarray) -> np.ndarray:
    """Return the part of a piece (J, I, 2), at most as large as the board, with most corners.

    Parts beyond which there are only squares cut by the board's rim come first.
    """
    there = np.isfinite(piece[..., 0])
    height, width = (min(size, most) for size, most in zip(there.shape, (rows, columns), strict=True))
    starts = product(range(there.shape[0] - height + 1), range(there.shape[1] - width + 1))
    parts = [_trim(piece[top : top + height, left : left + width]) for top, left in starts]
    parts.sort(key=count_corners, reverse=True)
    if len(parts) == 1:
        return parts[0]
    return next((part for part in parts if min(part.shape) > 1 and not has_more_corners(grey, part)), parts[0])


def _place_piece(piece: np.ndarray, columns: int, rows: int, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return the board (rows, columns, 2) with a piece (J, I, 2) in its place; None if this is ambiguous."""
    offsets = []
    for axis, size in enumerate((rows, columns)):
        along = np.moveaxis(piece, axis, 0)
        missing = size - len(along)
        if len(along) < 2:
            return None
        ends = [_is_side(along[0], along[1], shape), _is_side(along[-1], along[-2], shape)]
        if missing and ends[0] == ends[1]:
            return None
        offsets.append(missing if missing and ends[1] else 0)
    board = np.full((rows, columns, 2), np.nan)
    (down, right), (height, width) = offsets, piece.shape[:2]
    board[down : down + height, right : right + width] = piece
    return board


def _is_side(last: np.ndarray, before: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Return True if a row of corners (K, 2) is a side of the board: two of the next ones would be in the image."""
    beyond = (2.0 * last - before)[np.isfinite(last[:, 0]) & np.isfinite(before[:, 0])]
    rim = _Rule.ring_px + _Rule.rim_px
    inside = (beyond > rim) & (beyond < np.array(shape[::-1]) - 1 - rim)
    return bool(np.count_nonzero(inside.all(axis=1)) > 1)


def _compute_harmonics(grey: np.ndarray, pixels: np.ndarray, radius: float) -> np.ndarray:
    """Return Fourier coefficients (N, K) of the grey levels on circles around pixels (N, 2)."""
    count = _Rule.ring_places
    angle = 2.0 * np.pi / count * np.arange(count)
    places = pixels[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.fft.rfft(sample_levels(grey, places.reshape(-1, 2)).reshape(-1, count), axis=1) / count
