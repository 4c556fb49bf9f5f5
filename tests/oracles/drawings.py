"""Photographs of flat prints, drawn ray by ray: the mean of samples in each pixel, for any lens given as rays."""

from collections.abc import Callable

import numpy as np

Rays = Callable[[np.ndarray], np.ndarray]
"""Directions (N, 3) in the camera frame of pixels (N, 2)."""
Print = Callable[[np.ndarray], np.ndarray]
"""Reflectances (N,) of places (N, 2) in the target's plane, mm."""


def pinhole(focal_px: float, centre_px: tuple[float, float]) -> Rays:
    """Return the rays of a camera without distortion."""
    return lambda pixels: np.column_stack([(pixels - centre_px) / focal_px, np.ones(len(pixels))])


def equidistant(focal_px: float, centre_px: tuple[float, float], *coefficients: float) -> Rays:
    """Return the rays of a lens with image radius f (a + k1 a^3 + k2 a^5 + ...) at the angle a, inverted by a table."""
    angles = np.linspace(0.0, np.pi / 2, 20001)
    radii = angles * (1.0 + sum(k * angles ** (2 * n) for n, k in enumerate(coefficients, 1)))
    rising = np.append(np.diff(radii) > 0, True).cumprod().astype(bool)

    def rays(pixels: np.ndarray) -> np.ndarray:
        plane = (pixels - centre_px) / focal_px
        radius = np.linalg.norm(plane, axis=1)
        angle = np.interp(radius, radii[rising], angles[rising], right=np.nan)
        across = plane * (np.sin(angle) / np.maximum(radius, 1e-12))[:, None]
        return np.column_stack([across, np.cos(angle)])

    return rays


def chessboard(
    columns: int,
    rows: int,
    square_mm: float,
    *,
    rims: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0),
    white_mm: float = 8.0,
    ground: float = 0.3,
) -> Print:
    """Return a board with this number of inner corners, the first one at the origin, on a plate with a white rim.

    ``rims`` are the widths of the outer squares on the left, top, right and bottom, in squares.
    """
    left, top, right, bottom = (square_mm * each for each in rims)
    low = np.array([-left, -top])
    high = np.array([(columns - 1) * square_mm + right, (rows - 1) * square_mm + bottom])

    def levels(places: np.ndarray) -> np.ndarray:
        board = ((places >= low) & (places <= high)).all(axis=1)
        plate = ((places >= low - white_mm) & (places <= high + white_mm)).all(axis=1)
        dark = np.floor(places / square_mm).sum(axis=1) % 2 == 0
        return np.where(board & dark, 0.08, np.where(plate, 0.85, ground))

    return levels


def circles(centres_mm: np.ndarray, diameter_mm: float, *, bright: bool = False, edge_mm: float = 10.0) -> Print:
    """Return equal circles on a plate that ends ``edge_mm`` beyond their centres."""
    low, high = centres_mm.min(axis=0) - edge_mm, centres_mm.max(axis=0) + edge_mm
    circle, plate = (0.85, 0.08) if bright else (0.08, 0.85)

    def levels(places: np.ndarray) -> np.ndarray:
        on_plate = ((places >= low) & (places <= high)).all(axis=1)
        inside = np.zeros(len(places), bool)
        x, y = places[on_plate].T
        inside[on_plate] = np.any([(x - u) ** 2 + (y - v) ** 2 <= diameter_mm**2 / 4 for u, v in centres_mm], axis=0)
        return np.where(inside, circle, np.where(on_plate, plate, 0.3))

    return levels


def pose(turns_deg: tuple[float, float, float], place_mm: tuple[float, float, float]) -> np.ndarray:
    """Return ``T_camera_target`` (4, 4): turned by angles about x, then y, then z of the camera, then moved."""
    (cx, cy, cz), (sx, sy, sz) = (fn(np.radians(turns_deg)) for fn in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = about_z @ about_y @ about_x, place_mm
    return result


def draw(
    levels: Print,
    rays: Rays,
    target_pose: np.ndarray,
    *,
    size: tuple[int, int],
    noise: float = 1.5,
    rng: np.random.Generator,
    samples: int = 4,
) -> np.ndarray:
    """Return the image (H, W) of uint8 of a print at ``T_camera_target``; each pixel is the mean of samples^2 rays."""
    width, height = size
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    image = np.zeros((height, width))
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height)), axis=2).reshape(-1, 2)
    turn, origin = target_pose[:3, :3], target_pose[:3, 3]
    for dv in offsets:
        for du in offsets:
            toward = rays(pixels + (du, dv)) @ turn
            with np.errstate(divide="ignore", invalid="ignore"):
                way = (turn.T @ origin)[2] / toward[:, 2]
                places = way[:, None] * toward[:, :2] - (turn.T @ origin)[:2]
            seen = np.isfinite(places).all(axis=1) & (way > 0)
            sampled = levels(np.where(seen[:, None], places, 1e6))
            image += np.where(seen, sampled, 0.3).reshape(height, width)
    image = 15.0 + 220.0 * image / samples**2 + noise * rng.normal(size=image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def project_points(points_mm: np.ndarray, rays: Rays, target_pose: np.ndarray, *, start: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) whose rays meet points (N, 2) of the target's plane, by Newton's method from ``start``.

    Derivatives are differences of the rays: no formula of a projection is used.
    """
    turn, origin = target_pose[:3, :3], target_pose[:3, 3]
    beyond = np.column_stack([points_mm, np.zeros(len(points_mm))]) @ turn.T + origin
    wanted, pixels = beyond[:, :2] / beyond[:, 2:], np.array(start, dtype=float)

    def slopes(at: np.ndarray) -> np.ndarray:
        toward = rays(at)
        return toward[:, :2] / toward[:, 2:]

    for _ in range(30):
        by_u, by_v = ((slopes(pixels + step) - slopes(pixels - step)) / 1e-2 for step in ((5e-3, 0.0), (0.0, 5e-3)))
        miss = wanted - slopes(pixels)
        determinant = by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0]
        step = np.stack(
            [miss[:, 0] * by_v[:, 1] - miss[:, 1] * by_v[:, 0], miss[:, 1] * by_u[:, 0] - miss[:, 0] * by_u[:, 1]],
            axis=1,
        )
        step /= determinant[:, None]
        pixels += np.clip(step, -50, 50)
    return pixels
