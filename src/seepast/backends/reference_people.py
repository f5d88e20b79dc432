"""The loops of the mask refinement (people.py) in NumPy, written to be read: their specification.

cpu_people.py has the same functions, and is tested against these bit for bit. Everything is integers, or float32
with the order of operations written here.

Common shapes: dynamic uint8 [K, H, W] (254ths of P(dynamic), 255 = NO_RAY); surfaces float32 [K, H, W], the
disparity D_k of what camera k sees, px over the array; saw uint8 [K, H, W, K], see `witnesses`. Object-level
functions look at every `stride`-th pixel only, the lattice [h, w] = [:, stride // 2 :: stride] of both axes.
"""

from __future__ import annotations

import numpy as np

from ..geometry import ArrayGeometry
from ..people import (
    COLOURS,
    LEVELS,
    MAX_POTENTIAL,
    MOMENTS,
    NATS,
    NO_SAY,
    POOLED,
    SHARE,
    SURPRISE,
    UNKNOWN,
    Cells,
    FieldCosts,
    Terms,
    lattice,
)
from ..rectify import NO_RAY
from .host_people import (  # noqa: F401
    disagreement,
    potentials_by,
    probability,
    share_histograms,
    sure_labels,
    surface_range,
    within,
)
from .reference import ray_offsets, rounded_ray


def set_threads(threads: int) -> None:
    """The reference has none to set."""


def seen_disparity(view: ArrayGeometry, camera: int, d: np.ndarray) -> np.ndarray:
    """d of a surface as view.reference measures it -> as `camera` does: its depth there is less by bz."""
    return d * (np.float32(1) / (np.float32(1) - d * view.offsets[camera, 2]))


# ----------------------------------------------------------------------------------------------- witnesses


def witnesses(dynamic: np.ndarray, surfaces: np.ndarray, geometry: ArrayGeometry, tolerance: float) -> np.ndarray:
    """What every camera says about the surface that every pixel shows: uint8 [K, H, W, K], saw[k, y, x, j].

    Camera j sees the surface at x of camera k if |D_j(x_j) - d_j| <= tolerance, x_j where that surface lies in j and
    d_j its disparity there; it then says its own P(dynamic) at x_j. NO_SAY elsewhere, and wherever a view has no ray.
    """
    K, height, width = dynamic.shape
    y, x = np.mgrid[:height, :width].astype(np.int32)
    saw = np.full((K, height, width, K), NO_SAY, np.uint8)
    for k in range(K):
        view, known = geometry.seen_from(k), dynamic[k] != NO_RAY
        for j in range(K):
            px, py = (x, y) if j == k else rounded_ray(view, j, x, y, surfaces[k])
            there = known & (px >= 0) & (px < width) & (py >= 0) & (py < height)
            at = py.clip(0, height - 1), px.clip(0, width - 1)
            same = np.abs(surfaces[j][at] - seen_disparity(view, j, surfaces[k])) <= np.float32(tolerance)
            saw[k, ..., j] = np.where(there & (same | (j == k)), dynamic[j][at], NO_SAY)
    return saw


# ------------------------------------------------------------------------------------------- objects' grid


def grid_position(geometry, camera, cells: Cells, surfaces, stride):
    """Where the lattice pixels of a camera lie in the grid: float32 [3, h, w] (disparity, y, x) in cells."""
    height, width = surfaces.shape[1:]
    y, x = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride].astype(np.int32)
    d, view = lattice(surfaces, stride)[camera], geometry.seen_from(camera)
    dx, dy = ray_offsets(view, geometry.reference, x, y, d)
    at = [seen_disparity(view, geometry.reference, d), y.astype(np.float32) + dy, x.astype(np.float32) + dx]
    return np.stack([
        ((v - np.float32(low)) * np.float32(1 / size) + np.float32(0.5)).clip(0, np.float32(last))
        for v, low, size, last in zip(at, cells.low, cells.size, cells.last, strict=True)
    ])  # fmt: skip


def pooled(saw: np.ndarray) -> np.ndarray:
    """Mean of what the cameras say: uint16 [...], POOLED steps per 254th of P; UNKNOWN where none says anything."""
    n = (saw != NO_SAY).sum(-1).astype(np.int32)
    total = np.where(saw != NO_SAY, saw, 0).sum(-1, dtype=np.int32)
    return np.where(n > 0, (POOLED * total + n // 2) // np.maximum(n, 1), UNKNOWN).astype(np.uint16)


def sloping(surfaces: np.ndarray, least: float, rows: int, stride: int) -> np.ndarray:
    """Lattice pixels on floors and ceilings: uint16 [K, h, w], UNKNOWN there and 0 elsewhere.

    The disparity changes by more than `least` px both to `rows` pixels above and from there to as many below, the same
    way: at an edge of an object it changes on one side only.
    """
    height = surfaces.shape[1]
    y = np.arange(stride // 2, height, stride)
    inside = (y >= rows) & (y + rows < height)
    here, columns = surfaces[:, y], np.s_[..., stride // 2 :: stride]
    above, below = here - surfaces[:, (y - rows).clip(0)], surfaces[:, (y + rows).clip(0, height - 1)] - here
    least = np.float32(least)
    slope = ((above > least) & (below > least)) | ((above < -least) & (below < -least))
    return np.where(slope & inside[:, None], np.uint16(UNKNOWN), np.uint16(0))[columns].copy()


def object_grid(saw, surfaces, geometry, cells: Cells, stride, floor) -> tuple[np.ndarray, np.ndarray]:
    """Pooled P of the lattice pixels uint16 [K, h, w], and its sum and count per cell, without those of `floor`
    (`sloping`): int64 [2, *cells.count]."""
    mean = pooled(lattice(saw, stride))
    sums = np.zeros((2, *cells.count), np.int64)
    for k in range(len(saw)):
        known = (mean[k] != UNKNOWN) & (floor[k] == 0)
        cell = np.floor(grid_position(geometry, k, cells, surfaces, stride) + np.float32(0.5)).astype(int)[:, known]
        np.add.at(sums[0], tuple(cell), mean[k][known].astype(np.int64))
        np.add.at(sums[1], tuple(cell), 1)
    return mean, sums


def object_slice(grid: np.ndarray, mean, surfaces, geometry, cells: Cells, stride) -> np.ndarray:
    """Trilinear slice of float32 grid [2, *cells.count] (sum of P, count) at the lattice pixels, divided.

    uint16 [K, h, w] in SHARE ths of P(dynamic); UNKNOWN where `mean` is.
    """
    out = np.full(mean.shape, UNKNOWN, np.uint16)
    for k in range(len(mean)):
        g = grid_position(geometry, k, cells, surfaces, stride)
        i = np.floor(g).astype(int)
        fd, fy, fx = g - i.astype(np.float32)
        corner = lambda plane, a, b, c: plane[i[0] + a, i[1] + b, i[2] + c]  # noqa: B023, E731

        def interpolated(plane):
            row = [[corner(plane, a, b, 0) + (corner(plane, a, b, 1) - corner(plane, a, b, 0)) * fx  # noqa: B023
                    for b in (0, 1)] for a in (0, 1)]  # fmt: skip
            layer = [r[0] + (r[1] - r[0]) * fy for r in row]  # noqa: B023
            return layer[0] + (layer[1] - layer[0]) * fd  # noqa: B023

        share = interpolated(grid[0]) / np.maximum(interpolated(grid[1]), np.float32(1e-6))
        value = np.floor(share.clip(0, 1) * np.float32(SHARE) + np.float32(0.5)).astype(np.uint16)
        out[k] = np.where(mean[k] != UNKNOWN, value, UNKNOWN)
    return out


# ------------------------------------------------------------------------------------------------ threshold


def border_counts(share, mean, surfaces, thresholds: np.ndarray, step: float, stride: int) -> np.ndarray:
    """For the region {share > t} of every threshold t, all views together: int64 [4, T].

    Rows: neighbouring pairs of lattice pixels that its border separates with the inside nearer by more than
    `step` px; all that it separates; sum of `mean` inside; pixels inside.
    """
    d, known = lattice(surfaces, stride), share != UNKNOWN
    counts = np.zeros((4, len(thresholds)), np.int64)
    for i, t in enumerate(thresholds):
        inside = known & (share > t)
        counts[2:, i] = mean[inside].sum(dtype=np.int64), inside.sum()
        for p, q in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:, :, :-1], np.s_[:, :, 1:])):
            border = (inside[p] != inside[q]) & known[p] & known[q]
            nearer = np.where(inside[p], d[p] - d[q], d[q] - d[p]) > np.float32(step)
            counts[:2, i] += (border & nearer).sum(), border.sum()
    return counts


# ---------------------------------------------------------------------------------------- what is behind them


def surprises(colour: np.ndarray, behind: list[np.ndarray], rays: list[np.ndarray], wanted: np.ndarray) -> np.ndarray:
    """How much every pixel differs from what other cameras see behind it: levels uint8 [K, H, W] by sum |dBGR|
    (SURPRISE), NO_SAY where it is not `wanted`, bool [K, H, W], or no ray shows it.

    colour uint8 [K, H, W, 3]; of every camera, behind uint8 [H, W, 3] (`blend`), and rays uint16 [H, W] that show it.
    """
    out = np.full(wanted.shape, NO_SAY, np.uint8)
    for k, (expected, seen) in enumerate(zip(behind, rays, strict=True)):
        step = np.abs(colour[k].astype(np.int32) - expected).sum(-1)
        out[k] = np.where(wanted[k] & (seen > 0), SURPRISE[step], NO_SAY)
    return out


def surprise_counts(surprise: np.ndarray, sure: np.ndarray, stride: int) -> np.ndarray:
    """Of surely static (0) and surely person's (1) lattice pixels, sure int8 [K, h, w], those of every level: int64
    [K, 2, LEVELS]."""
    at = lattice(surprise, stride)
    counts = np.zeros((len(at), 2, LEVELS), np.int64)
    for k in range(len(at)):
        for label, of in ((0, sure[k] < 0), (1, sure[k] > 0)):
            counts[k, label] = np.bincount(at[k][of & (at[k] != NO_SAY)], minlength=LEVELS)
    return counts


# -------------------------------------------------------------------------------------- what people look like


def colour_bin(colour: np.ndarray) -> np.ndarray:
    """16^3 bins of BGR [..., 3], grey [..., 1] on their diagonal: int32 [...]."""
    level = np.broadcast_to(colour >> 4, (*colour.shape[:-1], 3)).astype(np.int32)
    return (level[..., 0] << 8) | (level[..., 1] << 4) | level[..., 2]


def histograms(dynamic, colour, person, stride) -> tuple[np.ndarray, np.ndarray]:
    """Of lattice pixels by label person uint8 [K, h, w]: levels of P int64 [K, 2, LEVELS], colours int64 [2, 4096]."""
    dynamic, colour = lattice(dynamic, stride), colour_bin(lattice(colour, stride))
    levels, colours = np.zeros((len(dynamic), 2, LEVELS), np.int64), np.zeros((2, COLOURS**3), np.int64)
    for k in range(len(dynamic)):
        for label in (0, 1):
            of = (person[k] == label) & (dynamic[k] != NO_RAY)
            levels[k, label] += np.bincount(dynamic[k][of] >> 4, minlength=LEVELS)
            colours[label] += np.bincount(colour[k][of], minlength=COLOURS**3)
    return levels, colours


def colour_moments(colour, sure, stride, block) -> np.ndarray:
    """Sums over blocks of lattice pixels where sure int8 [K, h, w] is 1 (person) or -1 (static): int32 [K, r, c, 14].

    1, b, g, r, bb, bg, br, gg, gr, rr of all of them, then 1, b, g, r of the person's.
    """
    colour = np.broadcast_to(lattice(colour, stride), (*sure.shape, 3)).astype(np.int32)
    one = np.ones(sure.shape, np.int32)
    first = [one, *(colour[..., i] for i in range(3))]
    second = [colour[..., i] * colour[..., j] for i in range(3) for j in range(i, 3)]
    terms = [v * (sure != 0) for v in (*first, *second)] + [v * (sure > 0) for v in first]
    K, h, w = sure.shape
    rows, columns = -(-h // block), -(-w // block)
    padded = np.zeros((K, rows * block, columns * block, MOMENTS), np.int32)
    padded[:, :h, :w] = np.stack(terms, axis=-1)
    return padded.reshape(K, rows, block, columns, block, MOMENTS).sum((2, 4), dtype=np.int32)


# ------------------------------------------------------------------------------------------------ the field


def log_odds(saw, levels: np.ndarray, stride) -> np.ndarray:
    """Mean over the cameras j that see the surface of levels[j, level of its P], nats: float32 [K, h, w]."""
    saw = lattice(saw, stride)
    n = np.zeros(saw.shape[:3], np.int32)
    total = np.zeros(saw.shape[:3], np.float32)
    for j in range(saw.shape[-1]):
        says = saw[..., j] != NO_SAY
        total += np.where(says, levels[j, saw[..., j] >> 4], np.float32(0))
        n += says
    return total * (np.float32(1) / np.maximum(n, 1).astype(np.float32))


def potential(said, dynamic, colour, linear, sure, surprise, behind, terms: Terms, stride, cell) -> np.ndarray:
    """Log-odds u that a pixel shows a person, NATS ths of a nat: int16 [h, w] of one camera's lattice.

    u = terms.sure[sure] + terms.said said + terms.local clip(linear . (b, g, r, 1) - 1/2) + terms.colours[colour]
    + behind[surprise], which is nothing where there is no surprise and where it is sure to be static; 0 without a ray.

    said float32 [h, w] (`log_odds`); dynamic, surprise uint8 [H, W]; colour uint8 [H, W, C]; linear float32 [H, W, 4];
    sure int8 [h', w'], one value for cell x cell pixels of this lattice; behind float32 [LEVELS], terms.behind of this
    camera.
    """
    dynamic, colour, linear, surprise = (lattice(v[None], stride)[0] for v in (dynamic, colour, linear, surprise))
    h, w = said.shape
    y, x = np.mgrid[:h, :w]
    at = np.minimum(y // cell, sure.shape[0] - 1), np.minimum(x // cell, sure.shape[1] - 1)
    b, g, r = np.moveaxis(np.broadcast_to(colour, (h, w, 3)).astype(np.float32), -1, 0)
    half, limit = np.float32(0.5), np.float32(MAX_POTENTIAL)
    local = linear[..., 0] * b + linear[..., 1] * g + linear[..., 2] * r + linear[..., 3]
    local = (local - half).clip(-half, half) * np.float32(terms.local)
    known = (surprise != NO_SAY) & (sure[at] >= 0)
    unlike = np.where(known, behind[np.minimum(surprise, LEVELS - 1)], np.float32(0))
    u = terms.sure[sure[at] + 1] + said * np.float32(terms.said) + local + terms.colours[colour_bin(colour)] + unlike
    fixed = np.floor(u.clip(-limit, limit) * np.float32(NATS) + half).astype(np.int16)
    return np.where(dynamic != NO_RAY, fixed, np.int16(0))


potentials = potentials_by(potential)


def field(u: np.ndarray, colour, surfaces, costs: FieldCosts, stride) -> np.ndarray:
    """Beliefs of a two-label scanline field along 8 directions, from u int16 [K, h, w] (`potential`): int16 [K, h, w].

    On a chain of two labels the whole min-sum message is one number: t = u + clip(t_before, -w, w), with w the
    cost of changing the label between the two pixels; belief = u + sum over directions of clip(t_before, -w, w).
    """
    colour, surfaces = lattice(colour, stride).astype(np.int32), lattice(surfaces, stride)
    belief = u.astype(np.int32)
    for k, of_camera in enumerate(u.astype(np.int32)):
        for dy, dx in ((0, 1), (1, 1), (1, 0), (1, -1)):
            w = change_cost(colour[k], surfaces[k], dy, dx, costs)
            for sign in (1, -1):
                belief[k] += chain(of_camera, w, sign * dy, sign * dx)
    return belief.astype(np.int16)


def change_cost(colour, surface, dy, dx, costs: FieldCosts) -> np.ndarray:
    """Cost of changing the label between pixel (y, x) and (y - dy, x - dx): int32 [h, w], 0 where there is none."""
    h, w = surface.shape
    out = np.zeros((h, w), np.int32)
    here = np.s_[dy:, max(dx, 0) : w + min(dx, 0)]
    before = np.s_[: h - dy, max(-dx, 0) : w + min(-dx, 0)]
    step = colour[here] - colour[before]
    contrast = (step * step).sum(-1) * (3 // colour.shape[-1])
    cost = costs.contrast[np.minimum(contrast, len(costs.contrast) - 1)].astype(np.int32)
    cost = np.where(np.abs(surface[here] - surface[before]) > np.float32(costs.depth_step), cost * costs.cut >> 8, cost)
    out[here] = cost * 181 >> 8 if dy and dx else cost  # 181 / 256: 1 / sqrt 2 for the longer step
    return out


def chain(u, w, dy, dx) -> np.ndarray:
    """clip(t_before, -w, w) along direction (dy, dx): int32 [h, w]. w belongs to the later pixel in (+dy, dx) order."""
    if dy < 0 or (dy == 0 and dx < 0):  # the same chain backwards
        back = np.roll(w, (dy, dx), (0, 1))
        turned = chain(u[::-1, ::-1], back[::-1, ::-1], -dy, -dx)
        return turned[::-1, ::-1]
    if dy == 0:
        return chain(u.T, w.T, 1, 0).T
    out = np.zeros_like(u)
    t = u[0]
    for y in range(1, len(u)):
        before = np.roll(t, dx)  # what wraps around meets w = 0
        out[y] = np.clip(before, -w[y], w[y])
        t = u[y] + out[y]
    return out
