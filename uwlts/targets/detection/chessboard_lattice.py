"""Corners of a chessboard that is seen in whole or in part: a lattice grown over saddle points of the grey levels."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from scipy.spatial import KDTree

from uwlts.targets.detection.chessboard_grid import count_seen, levels_at, without_doubtful
from uwlts.targets.detection.lattice import STEPS, TOLERANCE

_SCALES = (1.0, 0.5, 0.25)
"""Sizes at which an image is searched: where it is blurred or large, corners are sharper at a smaller one."""
_SIGMA = 1.5  # px of the scaled image, blur before derivatives
_RING_PX = 6.0  # px of the scaled image, radius of the circle about a corner: within squares of more than 6 px
_INNER_RING = 0.6  # of that radius: a second circle
_RING = 24  # places on a circle, one every 1.6 px
_LEAST_SHARE = 0.7  # of the variation around a corner that comes twice a turn, as two dark and two bright sectors do
_LEAST_IN_PHASE = 0.9  # cosine between the sectors of both circles, which go straight outwards from a corner
_LEAST_CONTRAST = 2.0  # grey levels around a corner, above the rounding
_EDGE_SHARE = 0.4  # of two neighbours' contrast that the edge between them has at least
_EDGE_BESIDE = 0.12  # lengths of the edge, how far beside it its levels are taken: beyond blur, within its squares
_EDGE_PLACES = (0.25, 0.5, 0.75)  # lengths of the edge, where along it
_MOST_RATIO = 4.0  # between the contrasts of neighbours
_OPPOSITE = -0.5  # cosine between the phases of neighbours at most; they are opposite but for perspective
_NEIGHBOURS = 24  # corners about one that may be its neighbours: two rings of a square lattice
_MOST_SEEDS = 40  # pieces of lattice that are tried; the clearest corners come first
_SEED_SINE = 0.3  # of the angle between the two edges that a lattice grows from
_CLEAR_OF_RIM_PX = _RING_PX + 6.0  # of the scaled image; a corner so far inside would have been found


@dataclass(frozen=True)
class _Corners:
    """Candidates: places (N, 2), contrast (N,) and phase (N,) of the sectors around them, and the blurred image."""

    pixels: np.ndarray
    contrast: np.ndarray
    phase: np.ndarray
    grey: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray) -> "_Corners":
        grey = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SIGMA)
        along_x, along_y = (cv2.Scharr(grey, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
        xx, xy = (cv2.Scharr(along_x, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
        saddle = np.maximum(xy * xy - xx * cv2.Scharr(along_y, cv2.CV_32F, 0, 1), 0.0)
        side = 2 * int(np.ceil(2 * _SIGMA)) + 1
        highest = (saddle == cv2.dilate(saddle, np.ones((side, side)))) & (saddle > 0)
        rim = int(_RING_PX) + 2
        highest[:rim], highest[-rim:], highest[:, :rim], highest[:, -rim:] = False, False, False, False
        pixels = np.argwhere(highest)[:, ::-1].astype(np.float64)
        outer, inner = _harmonics(grey, pixels, _RING_PX), _harmonics(grey, pixels, _INNER_RING * _RING_PX)
        power = np.abs(outer[:, 1:]) ** 2
        share = power[:, 1] / np.maximum(power.sum(axis=1), 1e-9)
        in_phase = np.cos(np.angle(outer[:, 2]) - np.angle(inner[:, 2]))
        contrast = 2.0 * np.abs(outer[:, 2])
        good = (share > _LEAST_SHARE) & (in_phase > _LEAST_IN_PHASE) & (contrast > _LEAST_CONTRAST)
        return cls(pixels[good], contrast[good], np.angle(outer[good, 2]), grey)

    def edges(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Least difference (K,) of the grey levels left and right of the ways between corners (K,), with its sign.

        Over the smaller contrast of both ends; zero where the sign changes on the way, or where the corners' sectors
        are none of neighbours.
        """
        at, way = self.pixels[start], self.pixels[end] - self.pixels[start]
        across = _EDGE_BESIDE * np.stack([-way[:, 1], way[:, 0]], axis=1)
        places = [at + share * way for share in _EDGE_PLACES]
        steps = np.stack([levels_at(self.grey, each + across) - levels_at(self.grey, each - across) for each in places])
        contrasts = self.contrast[[start, end]]
        neighbours = (np.sign(steps) == np.sign(steps[0])).all(axis=0)
        neighbours &= contrasts.max(axis=0) < _MOST_RATIO * contrasts.min(axis=0)
        neighbours &= np.cos(self.phase[start] - self.phase[end]) < _OPPOSITE
        return np.where(neighbours, np.sign(steps[0]) * np.abs(steps).min(axis=0) / contrasts.min(axis=0), 0.0)

    def seeds(self, tree: KDTree) -> Iterator[tuple[int, np.ndarray]]:
        """Corners with an edge to neighbours two ways, and the steps (2, 2) to these; the clearest corners first."""
        ends = np.asarray(tree.query(self.pixels, k=min(_NEIGHBOURS + 1, len(self.pixels)))[1])[:, 1:]
        starts = np.repeat(np.arange(len(ends)), ends.shape[1])
        edges = self.edges(starts, ends.ravel()).reshape(ends.shape)
        sides = [sign * edges > _EDGE_SHARE for sign in (1, -1)]
        number = np.sum([side.sum(axis=1).clip(max=2) for side in sides], axis=0)
        both = np.flatnonzero(sides[0].any(axis=1) & sides[1].any(axis=1))
        for corner in sorted(both.tolist(), key=lambda c: (-number[c], -self.contrast[c])):
            first, second = (self.pixels[ends[corner, side[corner].argmax()]] - self.pixels[corner] for side in sides)
            turn = first[0] * second[1] - first[1] * second[0]
            if abs(turn) > _SEED_SINE * np.linalg.norm(first) * np.linalg.norm(second):
                yield corner, np.stack([first, second] if turn > 0 else [second, first])

    def grown(self, seed: int, steps: np.ndarray, tree: KDTree) -> dict[tuple[int, int], int]:
        """Places {(i, j): corner} of the piece of lattice around a seed.

        It grows along the edges between neighbours and, where these are at an end, over one corner that is not seen.
        """
        places, where, step_of = {(0, 0): seed}, {seed: (0, 0)}, {seed: steps}
        reach, frontier = 1, [seed]
        while frontier:
            asked = []
            for corner in frontier:
                step_of[corner] = self._steps_at(where[corner], places, step_of[corner])
                i, j = where[corner]
                for di, dj in STEPS:
                    if (place := (i + reach * di, j + reach * dj)) not in places:
                        step = (di + dj) * step_of[corner][abs(dj)]
                        asked.append((corner, place, self.pixels[corner] + reach * step, np.linalg.norm(step)))
            frontier = []
            if asked:
                nearest = tree.query(np.array([at for _, _, at, _ in asked]), k=min(4, len(self.pixels)))
                away, found = np.asarray(nearest[0]) / [[length] for *_, length in asked], np.asarray(nearest[1])
                for ask, rank in sorted(zip(*np.nonzero(away < TOLERANCE), strict=True), key=lambda at: away[at]):
                    (corner, place, _, _), other = asked[ask], int(found[ask, rank])
                    if place not in places and other not in where and self._belong(corner, other, reach):
                        places[place], where[other], step_of[other] = other, place, step_of[corner]
                        frontier.append(other)
            if frontier:
                reach = 1
            elif reach == 1:
                reach, frontier = 2, list(where)
        return places

    def _belong(self, corner: int, other: int, reach: int) -> bool:
        """Whether two corners may be one or two steps apart."""
        if reach == 1:
            return bool(abs(self.edges(np.array([corner]), np.array([other]))[0]) > _EDGE_SHARE)
        contrasts = self.contrast[[corner, other]]
        alike = np.cos(self.phase[corner] - self.phase[other]) > -_OPPOSITE
        return bool(alike and contrasts.max() < _MOST_RATIO * contrasts.min())

    def _steps_at(self, place: tuple[int, int], places: dict[tuple[int, int], int], usual: np.ndarray) -> np.ndarray:
        """Steps (2, 2) along i and j at a place: half the way between both neighbours, or that to one, or as usual."""
        (i, j), steps = place, usual.copy()
        here = self.pixels[places[place]]
        for axis, (after, before) in enumerate((((i + 1, j), (i - 1, j)), ((i, j + 1), (i, j - 1)))):
            ways = [self.pixels[places[after]] - here] if after in places else []
            ways += [here - self.pixels[places[before]]] if before in places else []
            if ways:
                steps[axis] = np.mean(ways, axis=0)
        return steps


def find_board(grey: np.ndarray, columns: int, rows: int) -> np.ndarray | None:
    """Corners (rows, columns, 2), NaN where one is not seen, of a board in a grey image (H, W); None without one.

    If a board is partly outside the image, the corners in view are numbered from the sides that are inside; None if
    their place is ambiguous. Corners are accurate to about a pixel, and the board may be turned by half a turn.
    """
    best = None
    for scale in _SCALES:
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
        if min(small.shape) < 8 * _RING_PX:
            break
        corners = _Corners.of(small)
        if len(corners.pixels) < 4:
            continue
        tree, tried, found = KDTree(corners.pixels), set(), {}
        for number, (seed, steps) in enumerate(corners.seeds(tree)):
            if number >= _MOST_SEEDS or len(found) >= columns * rows:
                break
            if seed not in tried:
                piece = corners.grown(seed, steps, tree)
                tried.update(piece.values())
                found = max(found, piece, key=len)
        board = _board(_piece(found, corners), columns, rows, small.shape)
        if board is not None and (best is None or count_seen(board) > count_seen(best)):
            best = (board + 0.5) / scale - 0.5
        if best is not None and count_seen(best) == columns * rows:
            break
    return best


def _piece(places: dict[tuple[int, int], int], corners: _Corners) -> np.ndarray:
    """Corners (J, I, 2) in their places, NaN where there is none, without doubtful ones."""
    indices, pixels = np.array(list(places)).reshape(-1, 2), corners.pixels[list(places.values())]
    if len(indices) == 0:
        return np.empty((0, 0, 2))
    indices = indices - indices.min(axis=0)
    piece = np.full((*(indices.max(axis=0) + 1)[::-1], 2), np.nan)
    piece[indices[:, 1], indices[:, 0]] = pixels
    return _trimmed(without_doubtful(corners.grey, piece))


def _trimmed(piece: np.ndarray) -> np.ndarray:
    """The piece without empty rows and columns around it."""
    there = np.isfinite(piece[..., 0])
    if not there.any():
        return np.empty((0, 0, 2))
    down, right = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    return piece[down[0] : down[-1] + 1, right[0] : right[-1] + 1]


def _board(piece: np.ndarray, columns: int, rows: int, shape: tuple[int, ...]) -> np.ndarray | None:
    """The board (rows, columns, 2) that contains a piece (J, I, 2); None if none does, or its place is ambiguous."""
    boards = []
    for turned in (piece, np.rot90(piece)):
        board = _within(_without_strays(turned, columns, rows), columns, rows, shape) if turned.size else None
        if board is not None:
            boards.append(board)
    counts = [count_seen(board) for board in boards]
    # A piece that fits both ways round belongs to no known place, but for a square board seen as a whole.
    if not boards or (len(boards) == 2 and counts[0] == counts[1] and not (columns == rows and counts[0] == rows**2)):
        return None
    return boards[int(np.argmax(counts))]


def _without_strays(piece: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """The part of a piece (J, I, 2) with most corners that is no larger than the board."""
    there = np.isfinite(piece[..., 0])
    height, width = (min(size, most) for size, most in zip(there.shape, (rows, columns), strict=True))
    starts = product(range(there.shape[0] - height + 1), range(there.shape[1] - width + 1))
    top, left = max(starts, key=lambda at: there[at[0] : at[0] + height, at[1] : at[1] + width].sum())
    return _trimmed(piece[top : top + height, left : left + width])


def _within(piece: np.ndarray, columns: int, rows: int, shape: tuple[int, ...]) -> np.ndarray | None:
    """The board (rows, columns, 2) with a piece (J, I, 2) at its place; None if the place is ambiguous."""
    offsets = []
    for axis, size in enumerate((rows, columns)):
        along = np.moveaxis(piece, axis, 0)
        missing = size - len(along)
        if len(along) < 2:
            return None
        ends = [_ends(along[0], along[1], shape), _ends(along[-1], along[-2], shape)]
        if missing and ends[0] == ends[1]:
            return None
        offsets.append(missing if missing and ends[1] else 0)
    board = np.full((rows, columns, 2), np.nan)
    (down, right), (height, width) = offsets, piece.shape[:2]
    board[down : down + height, right : right + width] = piece
    return board


def _ends(last: np.ndarray, before: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Whether a board ends with a row of corners (K, 2): most of the next ones would lie well within the image."""
    beyond = (2.0 * last - before)[np.isfinite(last[:, 0]) & np.isfinite(before[:, 0])]
    inside = (beyond > _CLEAR_OF_RIM_PX) & (beyond < np.array(shape[::-1]) - 1 - _CLEAR_OF_RIM_PX)
    return bool(len(beyond) and inside.all(axis=1).mean() > 0.5)


def _harmonics(grey: np.ndarray, pixels: np.ndarray, radius: float) -> np.ndarray:
    """Fourier coefficients (N, K) of the grey levels on circles about pixels (N, 2)."""
    angle = 2.0 * np.pi / _RING * np.arange(_RING)
    places = pixels[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.fft.rfft(levels_at(grey, places.reshape(-1, 2)).reshape(-1, _RING), axis=1) / _RING
