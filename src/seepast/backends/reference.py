"""The method in NumPy, written to be read: THE specification of every stage, slow on purpose.

Every other backend has these functions with these names, arguments and results, and is tested against them
bit for bit. Symbols are those of the paper and DESIGN.md: K cameras, reference pixel x, its ray x^k = W_k(x, d)
in camera k, disparity d over the full array, static label S^k.

Common shapes:  features: what `describe` returns, gradients int8 [K, 2, H, W];  dynamic uint8 [K, H, W] (254ths of
P(dynamic), 255 = NO_RAY);  static bool [K, H, W] (label of a camera's own pixel);  labels uint16 [H, W] (bit k: ray k
of this reference pixel is static);  points float32 [N, 3] (x, y, d in the reference view).
"""

from __future__ import annotations

import cv2
import numpy as np

from ..candidates import CELL, EIGHTHS, DisparityGrid, Prior, prior_energy
from ..confidence import of_labels as evidence  # noqa: F401
from ..evidence import NATS, POSTERIOR, UNCHANGED, posterior_index, prior_costs
from ..geometry import ArrayGeometry
from ..options import DisparityOptions, Options, PriorOptions, RefocusOptions, SupportOptions
from ..rectify import NO_RAY
from ..triangulation import delaunay, with_corners
from .host import QUEUES, after, depth, faults, fetched, input_masks, lane, mark, probability, received, rectified_frame  # noqa: F401

# The descriptor: where around the pixel which Sobel response is sampled, as (dy, dx). 12 horizontal and 4
# vertical gradients, since a horizontal array matches along x (Geiger et al. 2010, section 3.1).
PATTERN_DU = (
    (-2, 0),
    (-1, -2),
    (-1, 0),
    (-1, 2),
    (0, -1),
    (0, 0),
    (0, 0),
    (0, 1),
    (1, -2),
    (1, 0),
    (1, 2),
    (2, 0),
)
PATTERN_DV = ((-1, 0), (0, -1), (0, 1), (1, 0))
PATTERN_REACH = 2  # px, the farthest sample
SAMPLES = len(PATTERN_DU) + len(PATTERN_DV)
SUPPORT_BLOCK = (
    (-2, -2),
    (-2, 2),
    (2, -2),
    (2, 2),
)  # support points compare the descriptors of these four pixels


# ---------------------------------------------------------------------------------------------- describe


def describe(grey: np.ndarray) -> np.ndarray:
    """Sobel responses, the stuff of the descriptors: uint8 [K, H, W] -> int8 [K, 2, H, W], (du, dv) / 2.

    Cut at +-127, edges do not need more; halved only, because planes are won or lost on weak texture.
    """
    out = np.empty((len(grey), 2, *grey.shape[1:]), np.int8)
    for k, image in enumerate(grey):
        for g, (dx, dy) in enumerate(((1, 0), (0, 1))):
            response = cv2.Sobel(image, cv2.CV_16S, dx, dy, ksize=3, borderType=cv2.BORDER_REPLICATE)
            out[k, g] = np.clip(response >> 1, -127, 127)
    return out


# ----------------------------------------------------------------------------------------- rays and samples


def ray_offsets(geometry: ArrayGeometry, camera: int, x, y, d) -> tuple[np.ndarray, np.ndarray]:
    """W_k(x, d) - x as float32 (dx, dy): with s = 1 / (1 - d az), dx = (x - cx)(s - 1) - d ax s + sx, dy likewise."""
    ax, ay, az, sx, sy = geometry.offsets[camera]
    cx, cy = np.float32(geometry.center[0]), np.float32(geometry.center[1])
    x, y, d = (np.asarray(v, np.float32) for v in (x, y, d))
    s = np.float32(1) / (np.float32(1) - d * az)
    m = s - np.float32(1)
    return (x - cx) * m - d * ax * s + sx, (y - cy) * m - d * ay * s + sy


def quarter_positions(geometry: ArrayGeometry, camera: int, x, y, d) -> tuple[np.ndarray, np.ndarray]:
    """Where matching looks in camera k: x in quarter pixels, y in whole rows, both int32."""
    dx, dy = ray_offsets(geometry, camera, x, y, d)
    xq = 4 * np.asarray(x, np.int32) + np.floor(np.float32(4) * dx + np.float32(0.5)).astype(np.int32)
    return xq, np.asarray(y, np.int32) + np.floor(dy + np.float32(0.5)).astype(np.int32)


def half_positions(geometry: ArrayGeometry, camera: int, x, y, d) -> tuple[np.ndarray, np.ndarray]:
    """Where the many-view method looks in camera k: x in half pixels, y in whole rows, both int32."""
    dx, dy = ray_offsets(geometry, camera, x, y, d)
    xh = 2 * np.asarray(x, np.int32) + np.floor(np.float32(2) * dx + np.float32(0.5)).astype(np.int32)
    return xh, np.asarray(y, np.int32) + np.floor(dy + np.float32(0.5)).astype(np.int32)


def inside(xq: np.ndarray, row: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """True where both pixels that a quarter position interpolates between lie in the image."""
    last = (xq >> 2) + ((xq & 3) > 0)
    return (xq >= 0) & (last < shape[1]) & (row >= 0) & (row < shape[0])


def neighbours(xq: np.ndarray, row: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and the two columns of a quarter position, clamped into the image."""
    left = np.clip(xq >> 2, 0, shape[1] - 1)
    right = np.clip((xq >> 2) + ((xq & 3) > 0), 0, shape[1] - 1)
    return np.clip(row, 0, shape[0] - 1), left, right


def sample(plane: np.ndarray, xq: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Linear interpolation at quarter positions of an integer plane, rounded: int32."""
    row, left, right = neighbours(xq, row, plane.shape)
    phase = xq & 3
    return (plane[row, left].astype(np.int32) * (4 - phase) + plane[row, right].astype(np.int32) * phase + 2) >> 2


def ray_static(static: np.ndarray, xq: np.ndarray, row: np.ndarray) -> np.ndarray:
    """A ray is static only if every pixel that its sample touches is."""
    row_, left, right = neighbours(xq, row, static.shape)
    return inside(xq, row, static.shape) & static[row_, left] & static[row_, right]


def descriptor(gradients: np.ndarray, xq: np.ndarray, row: np.ndarray) -> np.ndarray:
    """f(x^k): int32 [..., 16] from one camera's int8 [2, H, W] at quarter positions."""
    du = [sample(gradients[0], xq + 4 * dx, row + dy) for dy, dx in PATTERN_DU]
    dv = [sample(gradients[1], xq + 4 * dx, row + dy) for dy, dx in PATTERN_DV]
    return np.stack(du + dv, axis=-1)


# ------------------------------------------------------------------------------------------------ variance


def variance_map(
    gradients: np.ndarray, static: np.ndarray, geometry: ArrayGeometry, d: float
) -> tuple[np.ndarray, np.ndarray]:
    """Var_S(f(x^1) ... f(x^K)) of every reference pixel at one disparity, and the static rays it rests on.

    Every one of the 16 samples takes the variance over the rays that are static *at that sample*, so that a
    descriptor that reaches over a person's edge is not spoilt by the person; samples with fewer than two static
    rays are left out and the sum scaled up to 16.

    Returns float32 [H, W] grey levels^2, and int32 [H, W] the pixel's own number of static rays n: the variance
    exists where n >= 2.
    """
    height, width = static.shape[1:]
    y, x = np.mgrid[:height, :width]
    n = np.zeros((height, width), np.int32)
    total = np.zeros((2, height, width), np.int32)
    squares = np.zeros((2, height, width), np.int32)
    for k in range(geometry.cameras):
        xq, row = quarter_positions(geometry, k, x, y, d)
        usable = ray_static(static[k], xq, row)
        n += usable
        for g in range(2):
            f = np.where(usable, sample(gradients[k, g], xq, row), 0)
            total[g] += f
            squares[g] += f * f
    known = n >= 2
    # (n sum f^2 - (sum f)^2) / n^2, in whole grey levels^2
    inverse = np.float32(1) / np.maximum(n, 1).astype(np.float32)
    var = ((n * squares - total * total).astype(np.float32) * (inverse * inverse)).astype(np.int32)
    packed = np.where(known, var + SAMPLE_KNOWN, 0)  # the variance and its count in one integer
    samples = [(0, *at) for at in PATTERN_DU] + [(1, *at) for at in PATTERN_DV]
    summed = np.sum([shifted(packed[g], dy, dx) for g, dy, dx in samples], axis=0)
    count = np.maximum(summed // SAMPLE_KNOWN, 1).astype(np.float32)
    scale = np.float32(SAMPLES) / count
    return (summed % SAMPLE_KNOWN).astype(np.float32) * scale, n


SAMPLE_KNOWN = 1 << 24  # room for 16 samples of at most 2^14 grey levels^2 below it


def shifted(plane: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """plane[y + dy, x + dx], 0 outside."""
    out = np.zeros_like(plane)
    height, width = plane.shape
    ys, yd = (slice(max(dy, 0), height + min(dy, 0)), slice(max(-dy, 0), height + min(-dy, 0)))
    xs, xd = (slice(max(dx, 0), width + min(dx, 0)), slice(max(-dx, 0), width + min(-dx, 0)))
    out[yd, xd] = plane[ys, xs]
    return out


# ------------------------------------------------------------------------------------------------- support


def support(
    features: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    grid: DisparityGrid,
    options: SupportOptions,
    near: np.ndarray | None = None,
) -> np.ndarray:
    """Sparse sure matches on static pixels, in the reference view: float32 [N, 3] (x, y, d), whole-pixel x, y.

    Every camera is matched with its neighbour in the array; what the reference does not see itself is
    reprojected into it. Duplicates merge, inconsistent points go. near bool [H, W]: the reference's own points are
    wanted only there.
    """
    clear, found = clear_of_people(static), []
    for base in range(geometry.cameras):
        points = into_reference(static, geometry, base, match_camera(features, clear, geometry, base, grid, options))
        if near is not None and base == geometry.reference:
            points = points[near[points[:, 1].astype(int), points[:, 0].astype(int)]]
        found.append(points)
    return consistent(merged(np.concatenate(found), static.shape[1:], options), options)


def match_camera(gradients, clear, geometry, base, grid, options) -> np.ndarray:
    """Support points of camera `base` in its own view: float32 [N, 4] (x, y, d, variance)."""
    view, partner = geometry.seen_from(base), neighbour_camera(geometry, base)
    x, y, d = match_grid(gradients, clear, view, partner, grid, options)
    d, variance = refine(gradients, clear, view, grid, partner, x, y, d)
    return np.stack([x, y, d, variance], axis=1).astype(np.float32)


NEAR = 64  # px: support points farther from a pixel than this hardly bear on its prior


def neighbourhood(wanted: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels within NEAR rows and columns of a wanted one."""
    sums = cv2.boxFilter(wanted.view(np.uint8), cv2.CV_32F, (2 * NEAR + 1,) * 2, normalize=False)
    return sums > 0.5


BLOCK_REACH = 4  # the four descriptors of a support point reach 2 + 2 px


def clear_of_people(static: np.ndarray) -> np.ndarray:
    """Static pixels whose whole support block is static: bool [K, H, W]. A block that reaches over a person's
    edge would give the background the person's disparity."""
    square = np.ones((2 * BLOCK_REACH + 1,) * 2, np.uint8)
    return np.stack([cv2.erode(view.view(np.uint8), square) for view in static]).astype(bool)


def neighbour_camera(geometry: ArrayGeometry, camera: int) -> int:
    """The next camera along the array, the previous one for the last."""
    order = np.argsort(geometry.positions[:, 0], kind="stable")
    place = int(np.flatnonzero(order == camera)[0])
    return int(order[place + 1] if place + 1 < len(order) else order[place - 1])


SUPPORT_MARGIN = BLOCK_REACH + 1  # so that interpolation stays in the image too


def within_margin(x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    m = SUPPORT_MARGIN
    return (x >= m) & (x < shape[1] - m) & (y >= m) & (y < shape[0] - m)


def neighbour_disparities(view: ArrayGeometry, partner: int, grid: DisparityGrid) -> np.ndarray:
    """Disparities that move the ray in `partner` by about one pixel each: float32 [n] px over the full array."""
    step = np.float32(1) / np.abs(view.offsets[partner, 0])
    first, last = grid.values[0], grid.values[-1]
    return first + step * np.arange(int((last - first) / step) + 1, dtype=np.float32)


def block(gradients: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The descriptors of four pixels around whole-pixel points: int32 [N, 64]."""
    return np.concatenate([descriptor(gradients, 4 * (x + dx), y + dy) for dy, dx in SUPPORT_BLOCK], axis=-1)


def match_grid(gradients, static, view, partner, grid, options):
    """Textured, unique, left-right consistent matches of grid points of view.reference in `partner`."""
    height, width = static.shape[1:]
    base = view.reference
    y, x = (v.ravel() for v in np.mgrid[0 : height : options.grid, 0 : width : options.grid].astype(np.int32))
    texture = np.abs(descriptor(gradients[base], 4 * x, y)).sum(-1)
    keep = within_margin(x, y, (height, width)) & (texture >= options.texture)
    keep[keep] = static[base, y[keep], x[keep]]
    x, y = x[keep], y[keep]
    d, ok = best_match(gradients, static, view, partner, grid, options, x, y)
    x, y, d = x[ok], y[ok], d[ok]
    px, py = rounded_ray(view, partner, x, y, d)
    back, ok = best_match(gradients, static, view.seen_from(partner), base, grid, options, px, py)
    bx, _ = rounded_ray(view.seen_from(partner), base, px, py, back)
    ok &= np.abs(bx - x) <= options.left_right
    return x[ok], y[ok], d[ok]


def rounded_ray(view, camera, x, y, d) -> tuple[np.ndarray, np.ndarray]:
    dx, dy = ray_offsets(view, camera, x, y, d)
    half = np.float32(0.5)
    return x + np.floor(dx + half).astype(np.int32), y + np.floor(dy + half).astype(np.int32)


def best_match(gradients, static, view, partner, grid, options, x, y) -> tuple[np.ndarray, np.ndarray]:
    """For points of view.reference: best disparity float32 [N], and whether it is sure bool [N].

    Cost: sum of absolute differences of the four descriptors around. Sure: cheap enough, and clearly cheaper
    than everything more than one step away.
    """
    candidates = neighbour_disparities(view, partner, grid)
    cost = np.full((len(candidates), len(x)), NO_MATCH, np.int32)
    here = block(gradients[view.reference], x, y)
    for i, d in enumerate(candidates):
        px, py = rounded_ray(view, partner, x, y, d)
        ok = within_margin(px, py, static.shape[1:])
        ok[ok] = static[partner, py[ok], px[ok]]
        cost[i, ok] = np.abs(block(gradients[partner], px[ok], py[ok]) - here[ok]).sum(-1)
    best = cost.argmin(0) if len(x) else np.zeros(0, int)
    lowest = cost[best, np.arange(len(x))]
    away = np.abs(np.arange(len(candidates))[:, None] - best) > 1
    second = np.where(away, cost, NO_MATCH).min(0, initial=NO_MATCH)
    sure = (lowest < np.float32(options.uniqueness) * second.astype(np.float32)) & (
        lowest <= np.float32(options.max_cost * 4 * SAMPLES)
    )
    return candidates[best], sure


NO_MATCH = 1 << 20


REFINE_REACH = np.float32(0.75)  # px in the partner: a whole-pixel match is off by half of one, or a little more


def refine(gradients, static, view, grid, partner, x, y, d) -> tuple[np.ndarray, np.ndarray]:
    """The candidate near d that has the least variance over all static rays, and that."""
    reach = REFINE_REACH / np.abs(view.offsets[partner, 0])
    steps = int(np.ceil(reach / np.float32(grid.step / 8)))
    nearest = np.floor((d * 8 - np.float32(grid.first)) / np.float32(grid.step) + np.float32(0.5)).astype(np.int32)
    best, lowest = nearest.clip(0, grid.count - 1), np.full(len(x), np.inf, np.float32)
    for j in range(-steps, steps + 1):
        index = nearest + j
        variance = ray_variance(gradients, static, view, x, y, grid.values[index.clip(0, grid.count - 1)])
        better = (index >= 0) & (index < grid.count) & (variance < lowest)
        best, lowest = np.where(better, index, best), np.where(better, variance, lowest)
    return grid.values[best], lowest


def ray_variance(gradients, static, view, x, y, d) -> np.ndarray:
    """Var_S of whole descriptors over the rays that are static: float32 [N] grey levels^2, inf with fewer than two."""
    n, spread = np.zeros(len(x), np.int32), np.zeros(len(x), np.int32)
    earlier: list[tuple[np.ndarray, np.ndarray]] = []
    for k in range(view.cameras):
        xq, row = quarter_positions(view, k, x, y, d)
        usable, f = ray_static(static[k], xq, row), descriptor(gradients[k], xq, row)
        for other, g in earlier:
            spread += np.where(usable & other, ((f - g) ** 2).sum(-1), 0).astype(np.int32)
        n += usable
        earlier.append((usable, f))
    inverse = np.float32(1) / np.maximum(n, 1).astype(np.float32)
    return np.where(n >= 2, spread.astype(np.float32) * (inverse * inverse), np.float32(np.inf))


def into_reference(static, geometry, base, points) -> np.ndarray:
    """Points (x, y, d, variance) of camera `base` in the reference; other cameras' only where it is blind."""
    view, reference = geometry.seen_from(base), geometry.reference
    if base == reference:
        return points
    x, y, d, variance = points.T
    px, py = rounded_ray(view, reference, x.astype(np.int32), y.astype(np.int32), d)
    d = d / (np.float32(1) - d * view.offsets[reference, 2])  # depth Z - bz: its disparity in the reference
    keep = (px >= 0) & (px < static.shape[2]) & (py >= 0) & (py < static.shape[1])
    keep[keep] = ~static[reference, py[keep], px[keep]]
    return np.stack([px, py, d, variance], axis=1).astype(np.float32)[keep]


def merged(points: np.ndarray, shape: tuple[int, int], options: SupportOptions) -> np.ndarray:
    """One point per bin of options.grid px, the one of least variance (the first of equals): [rows, columns, 3].

    d is NaN where a bin is empty.
    """
    rows, columns = (-(-size // options.grid) for size in shape)
    out = np.full((rows, columns, 3), np.nan, np.float32)
    order = np.lexsort((-np.arange(len(points)), -points[:, 3]))  # worst first, so that the best is written last
    x, y = points[order, 0].astype(int), points[order, 1].astype(int)
    out[y // options.grid, x // options.grid] = points[order, :3]
    return out


def consistent(bins: np.ndarray, options: SupportOptions) -> np.ndarray:
    """Drops points that too few neighbours agree with: [rows, columns, 3] -> float32 [N, 3], row by row."""
    d = bins[..., 2]
    reach = options.window // options.grid
    padded = np.pad(d, reach, constant_values=np.nan)
    agreeing = np.zeros(d.shape, int)
    for j in range(2 * reach + 1):
        for i in range(2 * reach + 1):
            other = padded[j : j + d.shape[0], i : i + d.shape[1]]
            agreeing += np.abs(other - d) <= np.float32(options.similar)
    return bins[agreeing - 1 >= options.min_agreeing]  # a point agrees with itself; NaN agrees with nothing


# --------------------------------------------------------------------------------------------------- prior


def prior(points: np.ndarray, shape: tuple[int, int], grid: DisparityGrid, options: PriorOptions) -> Prior:
    """Piecewise planar prior: Delaunay over the support points, mu(x) on its planes, candidates per cell.

    Without any support point every disparity is a candidate for every pixel and mu is the farthest one.
    """
    rows, columns = (-(-size // cell) for size, cell in zip(shape, CELL, strict=True))
    if not len(points):
        return Prior(np.full(shape, grid.first, np.int32), np.ones((rows, columns, grid.count), np.uint8))
    corners = with_corners(points, shape)
    mean = plane_means(corners, delaunay(corners, shape), shape, options.max_step)
    last = grid.first + grid.step * (grid.count - 1)
    return Prior(fill_gaps(mean).clip(grid.first, last), cell_candidates(points, (rows, columns), grid, options))


NO_PLANE = -(1 << 30)


def plane_means(points: np.ndarray, triangles: np.ndarray, shape: tuple[int, int], max_step: float) -> np.ndarray:
    """mu(x) in eighths of a pixel, int32 [H, W]: linear over every triangle; NO_PLANE outside all of them.

    A triangle whose corners differ by more than max_step px bridges a depth edge, where there is no plane: there
    mu is the disparity of the nearest corner. A pixel on a shared edge belongs to the earlier triangle.
    """
    mean = np.full(shape, NO_PLANE, np.int32)
    for corners in points[triangles].astype(np.float64):
        (x0, y0, d0), (x1, y1, d1), (x2, y2, d2) = corners
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0:
            continue
        left, right = int(min(x0, x1, x2)), int(max(x0, x1, x2))
        top, bottom = int(min(y0, y1, y2)), int(max(y0, y1, y2))
        y, x = np.mgrid[top : bottom + 1, left : right + 1].astype(np.float64)
        e0 = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
        e1 = (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)
        e2 = (x0 - x2) * (y - y2) - (y0 - y2) * (x - x2)
        covered = (e0 * area >= 0) & (e1 * area >= 0) & (e2 * area >= 0)
        if max(d0, d1, d2) - min(d0, d1, d2) > max_step:
            distances = [(x - px) ** 2 + (y - py) ** 2 for px, py, _ in corners]
            d = corners[np.argmin(distances, axis=0), 2]
        else:
            slope_x = ((d1 - d0) * (y2 - y0) - (d2 - d0) * (y1 - y0)) / area
            slope_y = ((d2 - d0) * (x1 - x0) - (d1 - d0) * (x2 - x0)) / area
            d = d0 + slope_x * (x - x0) + slope_y * (y - y0)
        window = mean[top : bottom + 1, left : right + 1]
        fresh = covered & (window == NO_PLANE)
        window[fresh] = np.floor(8 * d[fresh] + 0.5).astype(np.int32)
    return mean


def fill_gaps(mean: np.ndarray) -> np.ndarray:
    """Pixels that no triangle covers (slivers at the hull) take the nearest covered pixel of their row, or column."""
    for m in (mean, mean.T):
        for i in np.flatnonzero((m == NO_PLANE).any(1)):
            gaps, known = np.flatnonzero(m[i] == NO_PLANE), np.flatnonzero(m[i] != NO_PLANE)
            if len(known):
                m[i, gaps] = m[i, known[np.abs(known[None] - gaps[:, None]).argmin(1)]]
    return mean


def cell_candidates(points, cells: tuple[int, int], grid: DisparityGrid, options: PriorOptions) -> np.ndarray:
    """uint8 [rows, columns, count]: disparities near a support point of the 3x3 cells around are candidates."""
    out = np.zeros((cells[0] + 2, cells[1] + 2, grid.count), np.uint8)
    for x, y, d in points:
        row, column = int(y) // CELL[0], int(x) // CELL[1]
        near = np.abs(grid.values - d) <= np.float32(options.neighbour_radius)
        out[row : row + 3, column : column + 3, near] = 1
    return out[1:-1, 1:-1].copy()


# ----------------------------------------------------------------------------------------------- disparity


def disparity(
    features: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    prior: Prior,
    grid: DisparityGrid,
    wanted: np.ndarray,
    options: Options,
) -> np.ndarray:
    """M-step: argmin over the candidates of E(d) = beta Var_S - log[gamma + exp(-(d - mu)^2 / (2 sigma^2))].

    One static ray has no variance, and no ray shows nothing (METHOD "Traps"): options.disparity.lone_variance and
    unseen_variance stand for it, about what a true match has, so that neither wins by having fewer rays; among
    such candidates the prior decides.

    Returns float32 [H, W] px; ties go to the farther; 0 where `wanted` bool [H, W] is false.
    """
    shape = static.shape[1:]
    beta = np.float32(options.disparity.beta)
    lone, unseen = np.float32(options.disparity.lone_variance), np.float32(options.disparity.unseen_variance)
    table = prior_energy(options.prior)
    best = np.full(shape, np.inf, np.float32)
    found = np.zeros(shape, np.float32)
    for i, d in enumerate(grid.values):
        away = np.abs(grid.first + i * grid.step - prior.mean)
        candidate = wanted & is_candidate(prior, grid, i, options.prior.radius)
        if not candidate.any():
            continue
        variance, n = variance_map(features, static, geometry, d)
        variance = np.where(n >= 2, variance, np.where(n == 1, lone, unseen))
        energy = beta * variance + table[np.minimum(away, len(table) - 1)]
        better = candidate & (energy < best)
        best = np.where(better, energy, best)
        found = np.where(better, d, found)
    return found


def affected(
    changed: np.ndarray,
    geometry: ArrayGeometry,
    prior: Prior,
    grid: DisparityGrid,
    wanted: np.ndarray,
    options: Options,
) -> np.ndarray:
    """Reference pixels that a change of labels can concern: bool [H, W]; all others keep their disparity.

    changed bool [K, H, W]. A pixel's energy at a candidate looks at the labels that its rays, and those of the
    pixels its descriptor samples, end on: PATTERN_REACH around, one more where residual offsets bend the rows.
    """
    shape = wanted.shape
    square = np.ones((2 * (PATTERN_REACH + 1) + 1,) * 2, np.uint8)
    near = np.stack([cv2.dilate(view.view(np.uint8), square) for view in changed])
    y, x = np.mgrid[: shape[0], : shape[1]]
    out = np.zeros(shape, bool)
    for i, d in enumerate(grid.values):
        candidate = wanted & is_candidate(prior, grid, i, options.prior.radius)
        for k in range(geometry.cameras if candidate.any() else 0):
            xq, row = quarter_positions(geometry, k, x, y, d)
            for column in (xq >> 2, (xq >> 2) + 1):
                hit = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1]) & candidate
                hit[hit] = near[k, row[hit], column[hit]] > 0
                out |= hit
    return out


def is_candidate(prior: Prior, grid: DisparityGrid, i: int, radius: float) -> np.ndarray:
    """bool [H, W]: d_i is near the pixel's prior mean, or suggested by a support point around its cell."""
    height, width = prior.mean.shape
    of_cell = prior.cells[:, :, i].repeat(CELL[0], 0).repeat(CELL[1], 1)[:height, :width]
    return (np.abs(grid.first + i * grid.step - prior.mean) <= int(EIGHTHS * radius)) | (of_cell > 0)


def smooth(disparity: np.ndarray, prior: Prior, wanted: np.ndarray, options: DisparityOptions) -> np.ndarray:
    """5x5 medians, repeated, against the single wrong pixels of a pixelwise argmin: float32 [H, W] px.

    Around `wanted` the prior mean stands in; there the result is 0.
    """
    found = np.where(wanted, disparity, prior.mean.astype(np.float32) / EIGHTHS)
    for _ in range(options.median_passes):
        found = cv2.medianBlur(found, 5)
    return np.where(wanted, found, np.float32(0))


# -------------------------------------------------------------------------------------------- segmentation


def segmentation(
    features: np.ndarray,
    dynamic: np.ndarray,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    wanted: np.ndarray,
    options: Options,
) -> tuple[np.ndarray, np.ndarray]:
    """E-step: per reference pixel the best of the 2^K label sets, argmin_S beta Var_S - sum_k log p(S^k | S_P^k).

    Var_S = sum_{i<j in S} |f_i - f_j|^2 / |S|^2; a set of one ray or none has lone_variance in its place, or
    small sets would win. Rays that leave their image are never static. Ties: the smaller label number.

    disparity float32 [H, W]. Returns labels uint16 [H, W] and the posterior uint8 [K, H, W] of the rays whose
    label left the prior's side: 254ths of P(dynamic | the other labels), UNCHANGED (255) elsewhere. Where
    `wanted` bool [H, W] is false: no labels, nothing changed.
    """
    K, (height, width) = geometry.cameras, disparity.shape
    y, x = np.mgrid[:height, :width]
    f, exists, p = [], [], []
    for k in range(K):
        xq, row = quarter_positions(geometry, k, x, y, disparity)
        f.append(descriptor(features[k], xq, row))
        row_, left, right = neighbours(xq, row, (height, width))
        p.append(np.maximum(dynamic[k, row_, left], dynamic[k, row_, right]))
        exists.append(inside(xq, row, (height, width)) & (p[k] != NO_RAY))
    energy = label_energies(f, exists, p, options)
    labels = energy.argmin(-1).astype(np.uint16)
    posterior = flipped_posterior(labels, energy, exists, p)
    return np.where(wanted, labels, np.uint16(0)), np.where(wanted, posterior, np.uint8(UNCHANGED))


def label_energies(f, exists, p, options) -> np.ndarray:
    """float64 [H, W, 2^K] energies of all label sets, in 1024ths of a nat (NATS)."""
    K = len(f)
    costs, beta = prior_costs(options.segmentation), options.segmentation.beta
    lone = options.disparity.lone_variance
    pairs = {(i, j): ((f[i] - f[j]) ** 2).sum(-1) for i in range(K) for j in range(i)}
    out = np.empty((*p[0].shape, 1 << K))
    for s in range(1 << K):
        rays = [k for k in range(K) if s >> k & 1]
        spread = sum((pairs[i, j] for i in rays for j in rays if j < i), np.zeros(p[0].shape, int))
        variance = spread * (1 / len(rays) ** 2) if len(rays) > 1 else np.full(p[0].shape, lone)
        prior = np.zeros(p[0].shape, int)
        for k in range(K):
            cost = costs[s >> k & 1][np.minimum(p[k], 254)]
            prior += np.where(exists[k], cost, IMPOSSIBLE if s >> k & 1 else np.int64(0))
        out[..., s] = NATS * beta * variance + prior
    return out


IMPOSSIBLE = np.int64(1 << 40)


def flipped_posterior(labels, energy, exists, p) -> np.ndarray:
    """P(dynamic) of the rays whose label and prior disagree, from the energies with and without them."""
    out = np.full((len(p), *labels.shape), UNCHANGED, np.uint8)
    for k in range(len(p)):
        with_ray = np.take_along_axis(energy, (labels | (1 << k))[..., None].astype(np.int64), -1)[..., 0]
        without = np.take_along_axis(energy, (labels & ~np.uint16(1 << k))[..., None].astype(np.int64), -1)[..., 0]
        flipped = exists[k] & ((labels >> k & 1) != (p[k] < 127))
        out[k][flipped] = POSTERIOR[posterior_index((without - with_ray)[flipped])]
    return out


# ----------------------------------------------------------------------------------------------- refocus


def refocus(
    colour: np.ndarray,
    labels: np.ndarray,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    keep: np.ndarray,
    options: RefocusOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """I* = sum_k S^k I_k(x^k) / sum_k S^k (paper eq. 2), then a 3x3 median over what was synthesised.

    colour uint8 [K, H, W, C]; labels uint16 [H, W]; keep bool [H, W]: reference pixels that keep their own
    value. Returns background uint8 [H, W, C] and coverage uint8 [H, W], the number of static rays used. Pixels
    without any are filled from the nearest seen background; coverage 0 flags them.
    """
    total = np.zeros(colour.shape[1:], np.float32)
    height, width = labels.shape
    y, x = np.mgrid[:height, :width]
    for k in range(geometry.cameras):
        static = (labels >> k & 1).astype(bool)
        dx, dy = ray_offsets(geometry, k, x, y, disparity)
        total += np.where(static[..., None], bilinear(colour[k], x, y, dx, dy), np.float32(0))
    coverage = popcount(labels)
    mean = total / np.maximum(coverage, 1)[..., None].astype(np.float32)
    background = np.floor(mean + np.float32(0.5)).astype(np.uint8)
    background[keep] = colour[geometry.reference][keep]
    background = fill_unseen(background, coverage, disparity)
    if options.median:
        background = np.where(keep[..., None], background, median3(background))
    return background, coverage


def popcount(labels: np.ndarray) -> np.ndarray:
    """Number of static rays of every label set, uint8."""
    count = np.zeros(labels.shape, np.uint8)
    for k in range(16):
        count += (labels >> k & 1).astype(np.uint8)
    return count


def bilinear(image: np.ndarray, x, y, dx, dy) -> np.ndarray:
    """image uint8 [H, W, C] at (x + dx, y + dy), edges continued: float32 [H, W, C]."""
    height, width = image.shape[:2]
    left, top = np.floor(dx), np.floor(dy)
    fx, fy = (dx - left)[..., None], (dy - top)[..., None]
    columns = [np.clip(x + left.astype(np.int32) + i, 0, width - 1) for i in (0, 1)]
    rows = [np.clip(y + top.astype(np.int32) + i, 0, height - 1) for i in (0, 1)]
    (a, b), (c, d) = ([image[r, q].astype(np.float32) for q in columns] for r in rows)
    upper = a + (b - a) * fx
    return upper + ((c + (d - c) * fx) - upper) * fy


def median3(image: np.ndarray) -> np.ndarray:
    """3x3 median of every channel, edges continued."""
    return cv2.medianBlur(image, 3).reshape(image.shape)


def fill_unseen(background: np.ndarray, coverage: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Continues the seen background into pixels of coverage 0: a guess, and flagged as one by that 0.

    The nearest seen pixels to the left, right, top and bottom, weighted by 1 / distance^2; one that lies more
    than NEARER px nearer than the disparity found here is foreground, and counts FOREGROUND_WEIGHT of that.
    """
    total = np.zeros(background.shape, np.float32)
    weights = np.zeros(coverage.shape, np.float32)
    for row, column, distance in nearest_seen(coverage > 0):
        found = distance > 0
        weight = np.float32(1) / np.maximum(distance * distance, 1).astype(np.float32)
        nearer = disparity[row, column] > disparity + np.float32(NEARER)
        weight = np.where(nearer, weight * np.float32(FOREGROUND_WEIGHT), weight)
        weight = np.where(found, weight, np.float32(0))
        total += weight[..., None] * background[row, column].astype(np.float32)
        weights += weight
    fill = np.floor(total / np.where(weights > 0, weights, 1)[..., None] + np.float32(0.5)).astype(np.uint8)
    return np.where(((coverage == 0) & (weights > 0))[..., None], fill, background)


NEARER = 2.0
FOREGROUND_WEIGHT = 0.01


def nearest_seen(seen: np.ndarray):
    """For left, right, up, down: (row, column, distance) int32 [H, W] of the nearest seen pixel, distance 0 = none."""
    height, width = seen.shape
    y, x = np.mgrid[:height, :width].astype(np.int32)
    none = -(1 << 20)
    left = np.maximum.accumulate(np.where(seen, x, none), axis=1)
    right = -np.maximum.accumulate(np.where(seen, -x, none)[:, ::-1], axis=1)[:, ::-1]
    up = np.maximum.accumulate(np.where(seen, y, none), axis=0)
    down = -np.maximum.accumulate(np.where(seen, -y, none)[::-1], axis=0)[::-1]
    for column in (left, right):
        found = np.abs(column) < -none
        yield y, np.where(found, column, 0), np.where(found, np.abs(column - x), 0)
    for row in (up, down):
        found = np.abs(row) < -none
        yield np.where(found, row, 0), x, np.where(found, np.abs(row - y), 0)


# ------------------------------------------------------------------------------------------------- masks


def masks(
    labels: np.ndarray,
    posterior: np.ndarray,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    wanted: np.ndarray,
    dynamic: np.ndarray,
    static: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Labels belong to (reference pixel, camera) pairs; this carries them back into each camera's own pixels.

    Where several reference pixels land on one camera pixel the nearest surface (largest disparity, then the
    first in reading order) speaks for it: a nearer static thing in front is thus an occluder, not a person. What
    no reference pixel explains keeps its prior.

    wanted bool [H, W]: reference pixels whose disparity and labels were estimated. dynamic and static are the
    priors they leave. Returns dynamic uint8 [K, H, W] and static bool [K, H, W], refined.
    """
    dynamic, static = dynamic.copy(), static.copy()
    height, width = disparity.shape
    y, x = (v[wanted] for v in np.mgrid[:height, :width].astype(np.int32))
    d = disparity[wanted]
    order = np.lexsort((-np.arange(len(d)), d))  # farthest first, so that the nearest is written last
    x, y, d = x[order], y[order], d[order]
    for k in range(geometry.cameras):
        px, py = rounded_ray(geometry, k, x, y, d)
        hit = (px >= 0) & (px < width) & (py >= 0) & (py < height)
        hit[hit] = dynamic[k, py[hit], px[hit]] != NO_RAY
        label, value = (labels[y, x] >> k & 1).astype(bool), posterior[k, y, x]
        static[k, py[hit], px[hit]] = label[hit]
        value = np.where(value == UNCHANGED, dynamic[k, py.clip(0, height - 1), px.clip(0, width - 1)], value)
        refined = dynamic[k].copy()
        refined[py[hit], px[hit]] = value[hit]
        dynamic[k] = refined
    return dynamic, static
