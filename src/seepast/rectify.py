"""Stage "rectify": K cameras into one orientation and one intrinsic matrix (METHOD, stage 1).

For two cameras this is what stereoRectify does; for more there is no pairwise answer, so the orientation is
fitted to the array: x along the best-fit line through all camera centres, z as near as possible to the mean
optical axis. rectified_from_cam is a rotation, so no depth is needed. What the line leaves over, y and z
offsets of single cameras, stays in `ArrayGeometry.positions`, and the warp W_k carries it exactly.

An array that is already rectified keeps the reference's own pixel grid, and its images are not touched.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from .errors import InputError, RigError
from .geometry import ArrayGeometry
from .matching import neighbour_matches
from .pixel_maps import dense, fixed_point, inside
from .rig import Camera, Rig
from .sampling import MAX_DYNAMIC, NO_RAY, sampled, sampled_together
from .threads import on_threads

log = logging.getLogger("seepast")


MAX_AXIS_DEG = 45.0  # a camera looking farther than this from the common direction does not see the same way
MAX_HALF_FIELD_DEG = 60.0  # a plane image of more is nearly all stretched border: the rest is cut off
MIN_ZOOM = 0.75  # how far the focal length may shrink to keep the border of the field of view
CROOKED = 0.1  # warn when centres lie farther from their line than this part of the array's length
SAME_ROTATION = 1e-6  # radians: a thousandth of a pixel
SAME_ROW = 0.05  # px: rows that differ by whole pixels but for this need no resampling
SAME_PIXEL = 1e-3  # px: a map that moves nothing by more is the identity

ALL_ROWS = slice(None)


@dataclass(frozen=True, eq=False)
class Rectification:
    """How the images of one rig become rectified views, for one reference camera. Made by `rectify`.

    geometry            the rectified array: common intrinsics, size and camera centres
    rotation_from_cam   per camera float64[3, 3] rectified_from_cam: exactly the identity where it is one
    row_error_px        px, predicted from the calibration: the largest distance between where the rectified
                        images and W_k say a scene point is, and where the rig itself projects it. W_k carries
                        every offset, so only rounding is left (below 1e-3): it checks the maps, while
                        `measured_row_error` checks the calibration. `row_offset_px` tells what ignoring the
                        offsets off the line would cost.
    cameras             the rig's cameras, in order
    """

    geometry: ArrayGeometry
    rotation_from_cam: tuple[np.ndarray, ...]
    row_error_px: float
    cameras: tuple[Camera, ...]
    _fixed: tuple[tuple[np.ndarray, np.ndarray] | None, ...] = field(repr=False)
    _no_ray: tuple[np.ndarray | None, ...] = field(repr=False)
    _to_input: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = field(repr=False, default_factory=dict)

    @cached_property
    def maps(self) -> tuple[tuple[np.ndarray, np.ndarray] | None, ...]:
        """Per camera (map_x, map_y), float32[H, W]: the source pixel of every rectified pixel, NaN where there is
        none; or None: the camera's image already is the rectified view and passes through untouched.

        For users: seepast itself keeps the smaller fixed-point form.
        """
        return tuple(
            None if fixed is None else _masked_map(camera, _source(self.geometry, k, camera, rotation))
            for k, (camera, rotation, fixed) in enumerate(
                zip(self.cameras, self.rotation_from_cam, self._fixed, strict=True)
            )
        )

    def passes_through(self, camera: int) -> bool:
        """Whether the camera's image already is its rectified view."""
        return self._fixed[camera] is None

    def image(
        self,
        camera: int,
        image: np.ndarray,
        interpolation: str = "cubic",
        out: np.ndarray | None = None,
        rows: slice = ALL_ROWS,
    ) -> np.ndarray:
        """uint8 [h, w] or [h, w, C] of `camera` -> its rectified view, [H, W] or [H, W, C]; or `rows` of it.

        interpolation "cubic" or "linear": cubic is 2.5 dB nearer to a textured photograph, linear takes a fifth of
        the time. Where no source pixel exists the nearest border pixel is repeated (`dynamic` says where), so that
        no edge appears that the scene does not have. The input itself where the camera passes through; else `out`,
        if given, is written and returned. InputError for a size that is not the calibrated one.
        """
        self._check_size(camera, image, "image")
        fixed = self._fixed[camera]
        if fixed is None:
            return image if rows == ALL_ROWS else image[rows]
        return sampled(image, fixed, interpolation, rows, out)

    def dynamic(
        self, camera: int, mask: np.ndarray | None, out: np.ndarray | None = None, rows: slice = ALL_ROWS
    ) -> np.ndarray:
        """uint8 [h, w] 255 * P(dynamic), or None for "nothing moves" -> uint8 [H, W], rectified; or `rows` of it.

        0..254 are 254ths of P(dynamic) (255 comes out as 254); NO_RAY = 255 where there is no source pixel.
        `out`, if given, is written and returned. InputError for a size that is not the calibrated one.
        """
        width, height = self.geometry.size
        out = np.empty((len(range(height)[rows]), width), np.uint8) if out is None else out
        if mask is not None:
            self._check_size(camera, mask, "mask")
        fixed = self._fixed[camera]
        if mask is None or not cv2.countNonZero(mask):
            out[...] = 0
        elif fixed is None:
            out[...] = mask[rows]
        else:
            sampled(mask, fixed, "linear", rows, out)
        return self._mark(camera, out, rows)

    def together(
        self,
        camera: int,
        image: np.ndarray,
        mask: np.ndarray,
        out: np.ndarray,
        dynamic: np.ndarray,
        rows: slice = ALL_ROWS,
    ) -> None:
        """`image` of a colour image, "linear", into `out`, and `dynamic` of its mask into that: at once, which is
        faster. For cameras that do not pass through."""
        self._check_size(camera, image, "image")
        self._check_size(camera, mask, "mask")
        fixed = self._fixed[camera]
        assert fixed is not None
        no_ray = self._no_ray[camera]
        assert no_ray is not None
        sampled_together(image, mask, fixed, rows, out, dynamic, no_ray[rows])

    def _mark(self, camera: int, sampled: np.ndarray, rows: slice = ALL_ROWS) -> np.ndarray:
        """`rows` of a sampled mask, in place: MAX_DYNAMIC at most, and NO_RAY where there is no source pixel."""
        cv2.min(sampled, MAX_DYNAMIC, dst=sampled)  # type: ignore[call-overload]
        no_ray = self._no_ray[camera]
        return sampled if no_ray is None else np.maximum(sampled, no_ray[rows], out=sampled)

    def masks_to_input(
        self,
        camera: int,
        rectified_mask: np.ndarray,
        input_mask: np.ndarray | None,
        out: np.ndarray | None = None,
        rows: slice = ALL_ROWS,
    ) -> np.ndarray:
        """A refined mask, uint8 [H, W] of 255 * P(dynamic), in `camera`'s own pixels, uint8 [h, w]; or `rows` of it.

        Sampled bilinearly; pixels which the rectified view does not reach keep the input mask's value (0 if
        it is None); what the rectified mask holds where `dynamic` says NO_RAY is never used. The rectified
        mask itself where the camera passes through; else `out`, if given, is written and returned.
        """
        if input_mask is not None:
            self._check_size(camera, input_mask, "mask")
        if self._fixed[camera] is None:
            return rectified_mask if rows == ALL_ROWS else rectified_mask[rows]
        whole, fraction, unreached = self.to_input(camera)
        mask = sampled(rectified_mask, (whole, fraction), "linear", rows, out)
        own = np.zeros_like(mask) if input_mask is None else input_mask[rows]
        return cv2.copyTo(own, unreached[rows], mask)

    def from_input(self, camera: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """What `image` and `dynamic` need: fixed-point maps (pixel_maps.fixed_point), and uint8 [H, W], NO_RAY or 0.
        None where the camera passes through."""
        fixed, no_ray = self._fixed[camera], self._no_ray[camera]
        return None if fixed is None or no_ray is None else (*fixed, no_ray)

    def to_input(self, camera: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What `masks_to_input` needs, made at the first call: fixed-point maps, and uint8 [h, w], not 0 where the view
        does not reach."""
        if camera not in self._to_input:
            self._to_input[camera] = _inverse_map(self, camera)
        return self._to_input[camera]

    def row_offset_px(self, depth: float = 2.0) -> float:
        """Rows that W_k must carry: the largest row difference in px, over the reference view, between the
        reference and any camera, of points `depth` metres away. 0 for cameras exactly on their line."""
        x, y = _sample_grid(self.geometry.size)
        d = np.full_like(x, self.geometry.focal_baseline / depth)
        width, height = self.geometry.size
        largest = 0.0
        for k in range(self.geometry.cameras):
            xk, yk = self.geometry.warp(k, x, y, d)
            seen = (xk >= 0) & (xk <= width - 1) & (yk >= 0) & (yk <= height - 1)
            largest = max(largest, float(abs(yk - y)[seen].max(initial=0.0)))
        return largest

    def _check_size(self, camera: int, image: np.ndarray, what: str) -> None:
        width, height = self.cameras[camera].resolution
        if image.shape[:2] != (height, width):
            raise InputError(
                f"{what} of {self.cameras[camera].name} is {image.shape[1]}x{image.shape[0]}, but the rig "
                f"was calibrated at {width}x{height}; give full-size images or a rig file of this size"
            )


_cache: WeakKeyDictionary[Rig, dict[int, Rectification]] = WeakKeyDictionary()


def rectify(rig: Rig, reference: int | str = 0) -> Rectification:
    """Rectify an array of K >= 2 cameras; cached for as long as the rig lives.

    Orientation: x along the least-squares line through the camera centres, pointing the way of the
    reference's x axis (of its y axis if the array stands upright); z as close as possible to the mean optical
    axis.

    Intrinsics: the reference's own, if it is an undistorted pinhole camera of that orientation; cameras of that
    kind with the same focal length, and rows apart by whole pixels, keep their own principal point
    (`ArrayGeometry.shifts`) and their images pass through. Else one focal length for x and y: the mean of the
    cameras' own at their centres, less (down to MIN_ZOOM of it) where that keeps the border of the field of view;
    each view's principal point centres its own content along the array, and all contents across it. Fields wider
    than 2 * MAX_HALF_FIELD_DEG are cut to about that. The size is the reference's (width and height swapped if the
    array's line runs along the reference's columns).

    Raises RigError if a camera looks more than MAX_AXIS_DEG away from the common direction, or if the array
    is lined up along the viewing direction.
    """
    index = rig.index(reference)
    made = _cache.setdefault(rig, {})
    if index not in made:
        made[index] = _rectify(rig, index)
    return made[index]


def _rectify(rig: Rig, reference: int) -> Rectification:
    rectified_from_rig = _orientation(rig, reference)
    rotations = tuple(_snapped(rectified_from_rig @ camera.rotation.T) for camera in rig.cameras)
    focal, principal_points, size = _intrinsics(rig, reference, rotations)
    centers = rig.centers
    positions = (centers - centers[reference]) @ rectified_from_rig.T
    positions[abs(positions) < 1e-9 * abs(positions).max()] = 0.0  # rounding: a straight array is exactly straight
    cx, cy = principal_points[reference]
    shifts = principal_points - principal_points[reference]
    geometry = ArrayGeometry(focal, (float(cx), float(cy)), size, positions, reference, shifts=shifts)
    made = on_threads(lambda k: _view(geometry, k, rig.cameras[k], rotations[k]), len(rig))
    sources, fixed, no_ray = zip(*made, strict=True)
    error = _closed_loop_error(rig.cameras, rotations, geometry, sources)
    log.info("rectified %d cameras: %.1f px focal length, row error %.1g px", len(rig), focal[0], error)
    return Rectification(geometry, rotations, error, rig.cameras, fixed, no_ray)


def _orientation(rig: Rig, reference: int) -> np.ndarray:
    """float64[3, 3] rectified_from_rig."""
    x = _line(rig, reference)
    axes = np.stack([camera.rotation[2] for camera in rig.cameras])
    mean = axes.mean(axis=0)
    z = mean - (mean @ x) * x
    off = np.degrees(np.arccos(np.clip(axes @ x, -1, 1)))
    agreement, enough = np.linalg.norm(mean), np.cos(np.radians(MAX_AXIS_DEG))
    if agreement > enough and np.linalg.norm(z) < enough * agreement:
        raise RigError(
            "the cameras are lined up along their viewing direction (the line through them is "
            f"{90 - abs(90 - off[reference]):.0f} degrees off {rig.cameras[reference].name}'s optical axis, "
            f"it must be {MAX_AXIS_DEG:g}): an array stands side by side; check the extrinsics' direction"
        )
    z /= max(float(np.linalg.norm(z)), 1e-12)
    angles = np.degrees(np.arccos(np.clip(axes @ z, -1, 1)))
    if angles.max() > MAX_AXIS_DEG:
        listed = ", ".join(f"{c.name} {a:.0f}" for c, a in zip(rig.cameras, angles, strict=True))
        raise RigError(
            f"the cameras do not see the same way: degrees off the common viewing direction are {listed}, "
            f"at most {MAX_AXIS_DEG:g} are allowed; use only cameras which look in one direction"
        )
    return np.stack([x, np.cross(z, x), z])


def _line(rig: Rig, reference: int) -> np.ndarray:
    """Unit direction, in the rig frame, of the least-squares line through the camera centres."""
    centered = rig.centers - rig.centers.mean(axis=0)
    _, _, directions = np.linalg.svd(centered, full_matrices=False)
    x = directions[0]
    along = centered @ x
    off_line = np.linalg.norm(centered - along[:, None] * x, axis=1).max()
    if off_line > CROOKED * np.ptp(along):
        log.warning(
            "the array is far from linear: a camera is %.3f m off the line of the %.3f m long array; hidden "
            "background is found along the line only",
            off_line,
            np.ptp(along),
        )
    right, down = rig.cameras[reference].rotation[0], rig.cameras[reference].rotation[1]
    upright = abs(x @ down) > abs(x @ right)
    return -x if x @ (down if upright else right) < 0 else x


def _snapped(rotation: np.ndarray) -> np.ndarray:
    """Exactly the identity where the rotation is one but for rounding."""
    return np.eye(3) if np.linalg.norm(rotation - np.eye(3)) < SAME_ROTATION else rotation


Intrinsics = tuple[tuple[float, float], np.ndarray, tuple[int, int]]


def _intrinsics(rig: Rig, reference: int, rotations: tuple[np.ndarray, ...]) -> Intrinsics:
    """(fx, fy), the principal point of every view float64[K, 2], (width, height): all but the middle one shared."""
    own, rotation = rig.cameras[reference], rotations[reference]
    if own.undistorted and np.array_equal(rotation, np.eye(3)):
        fx, fy, *center = own.intrinsics
        same = [_passes_through(c, r, own) for c, r in zip(rig.cameras, rotations, strict=True)]
        points = [c.intrinsics[2:] if s else center for c, s in zip(rig.cameras, same, strict=True)]
        return (fx, fy), np.array(points, np.float64), own.resolution
    width, height = own.resolution
    if abs(rotation[0, 1]) > abs(rotation[0, 0]):
        width, height = height, width
    boxes = np.stack([_content_box(c, r) for c, r in zip(rig.cameras, rotations, strict=True)])
    low, high = boxes.mean(axis=0)
    central = float(np.mean([_central_focal(camera) for camera in rig.cameras]))
    fitting = float(np.min(np.array([width, height]) / (high - low)))
    focal = float(np.clip(fitting, MIN_ZOOM * central, central))
    middle = boxes.mean(axis=1)  # of each view's content
    middle[:, 1] = (low[1] + high[1]) / 2  # rows stay aligned
    return (focal, focal), np.array([width - 1, height - 1]) / 2 - focal * middle, (width, height)


def _passes_through(camera: Camera, rectified_from_cam: np.ndarray, reference: Camera) -> bool:
    """Whether the camera's image already is a rectified view, except perhaps for where its principal point lies."""
    return (
        camera.undistorted
        and np.array_equal(rectified_from_cam, np.eye(3))
        and camera.intrinsics[:2] == reference.intrinsics[:2]
        and camera.resolution == reference.resolution
        and abs((rows := camera.intrinsics[3] - reference.intrinsics[3]) - round(rows)) < SAME_ROW
    )


def _content_box(camera: Camera, rectified_from_cam: np.ndarray) -> np.ndarray:
    """float64[2, 2]: lowest and highest (X/Z, Y/Z) of the medians of the image's four borders, rectified.

    Medians, since corners of an undistorted image stick far out: half of each border is kept, half is cut.
    """
    w, h = camera.resolution
    t = np.linspace(0, 1, 33)
    x, y = t * (w - 1), t * (h - 1)
    borders = [(0 * t, y), (0 * t + w - 1, y), (x, 0 * t), (x, 0 * t + h - 1)]
    pixels = np.stack([np.stack(border, axis=-1) for border in borders])
    rays = camera.unproject(pixels) @ rectified_from_cam.T
    # Beyond the limit (or beyond what the model can see) only the direction around the axis counts.
    outward = (pixels - np.array(camera.intrinsics[-2:])) @ rectified_from_cam[:2, :2].T
    lost = np.isnan(rays[..., 2])
    rays[lost] = np.concatenate([outward[lost], np.zeros_like(outward[lost][:, :1])], axis=-1)
    limit = np.tan(np.radians(MAX_HALF_FIELD_DEG))
    radius = np.hypot(rays[..., 0], rays[..., 1])
    tangent = np.where(rays[..., 2] > radius / limit, radius / np.maximum(rays[..., 2], 1e-12), limit)
    plane = rays[..., :2] / np.maximum(radius, 1e-12)[..., None] * tangent[..., None]
    middle = np.sort(plane, axis=1)[:, plane.shape[1] // 2]  # np.median would load numpy.ma first: 20 ms
    return np.stack([middle.min(axis=0), middle.max(axis=0)])


def _central_focal(camera: Camera) -> float:
    """Pixels per unit of X/Z at the optical axis, mean of x and y."""
    step = 1e-4
    pixels = camera.project(np.array([[-step, 0, 1], [step, 0, 1], [0, -step, 1], [0, step, 1]]))
    lengths = np.linalg.norm(pixels[1::2] - pixels[::2], axis=-1) / (2 * step)
    return float(lengths.mean())


View = tuple[np.ndarray | None, tuple[np.ndarray, np.ndarray] | None, np.ndarray | None]


def _view(geometry: ArrayGeometry, index: int, camera: Camera, rectified_from_cam: np.ndarray) -> View:
    """One camera's source pixels, the same for cv2.remap, and uint8[H, W] NO_RAY where there is none, else 0.

    Three times None where the camera's image already is the rectified view.
    """
    source = _source(geometry, index, camera, rectified_from_cam)
    if source is None:
        return None, None, None
    no_ray = ~inside(source, camera.resolution) * np.uint8(NO_RAY)
    return source, fixed_point(source, camera.resolution), no_ray


def _source(geometry: ArrayGeometry, index: int, camera: Camera, rectified_from_cam: np.ndarray) -> np.ndarray | None:
    """float32[2, H, W] source pixel of every rectified pixel, also off the image; None for the identity."""
    focal, center = np.array(geometry.focal), np.array(geometry.center) + geometry.shifts[index]

    def projected(pixels: np.ndarray) -> np.ndarray:
        plane = (pixels - center) / focal
        return camera.project(np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1) @ rectified_from_cam)

    source = dense(projected, geometry.size)
    same = camera.resolution == geometry.size and _unmoved(source, 32) and _unmoved(source, 1)
    return None if same else source


def _unmoved(source: np.ndarray, every: int) -> bool:
    """Whether every so many-th pixel of both directions stays where it is."""
    height, width = source.shape[1:]
    y, x = np.ogrid[:height:every, :width:every]
    off_x, off_y = source[0, ::every, ::every] - x, source[1, ::every, ::every] - y
    return bool((abs(off_x) < SAME_PIXEL).all() and (abs(off_y) < SAME_PIXEL).all())


def _masked_map(camera: Camera, source: np.ndarray | None) -> tuple[np.ndarray, np.ndarray] | None:
    if source is None:
        return None
    map_x, map_y = np.where(inside(source, camera.resolution), source, np.float32(np.nan))
    return map_x, map_y


def _inverse_map(rectification: Rectification, camera: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fixed-point maps, the rectified pixel of every input pixel, and where the rectified view does not reach it."""
    own, geometry = rectification.cameras[camera], rectification.geometry
    focal, center = np.array(geometry.focal), np.array(geometry.center) + geometry.shifts[camera]

    def rectified(pixels: np.ndarray) -> np.ndarray:
        rays = own.unproject(pixels) @ rectification.rotation_from_cam[camera].T
        ahead = np.where(rays[..., 2:] > 0, rays[..., 2:], np.nan)
        return rays[..., :2] / ahead * focal + center

    target = dense(rectified, own.resolution)
    whole, fraction = fixed_point(target, geometry.size)
    reached = inside(target, geometry.size)
    no_ray = rectification._no_ray[camera]
    if no_ray is not None:  # what a refined mask holds there means nothing and must not bleed in
        reached &= cv2.remap(no_ray, whole, fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) == 0
    return whole, fraction, (~reached).view(np.uint8)


def _sample_grid(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, 17), np.linspace(0, size[1] - 1, 17))
    return x.ravel(), y.ravel()


def _closed_loop_error(
    cameras: tuple[Camera, ...],
    rotations: tuple[np.ndarray, ...],
    geometry: ArrayGeometry,
    sources: Sequence[np.ndarray | None],
) -> float:
    """Largest distance in px between map_k(W_k(x, d)) and the rig's own projection, over view and depths."""
    x, y = _sample_grid(geometry.size)
    (fx, fy), (cx, cy) = geometry.focal, geometry.center
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    largest = 0.0
    for depth in geometry.baseline * np.array([3.0, 10.0, 100.0]):
        d = np.full_like(x, geometry.focal_baseline / depth)
        for k, (camera, source) in enumerate(zip(cameras, sources, strict=True)):
            truth = camera.project((rays * depth - geometry.positions[k]) @ rotations[k])
            xk, yk = geometry.warp(k, x, y, d)
            found = np.stack([xk, yk], axis=-1) if source is None else _bilinear(source, xk, yk)
            error = np.linalg.norm(found - truth, axis=-1)
            inside = ((truth >= 0) & (truth <= np.array(camera.resolution) - 1.0)).all(axis=-1)
            largest = max(largest, float(np.nanmax(error[inside & ~np.isnan(error)], initial=0.0)))
    return largest


def _bilinear(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """values[C, H, W] at (x, y), as [..., C]; NaN outside."""
    values = np.moveaxis(values, 0, -1)
    height, width = values.shape[:2]
    x, y = x.astype(np.float64), y.astype(np.float64)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    i, j = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    s, t = (x - i)[..., None], (y - j)[..., None]
    top = (1 - s) * values[j, i] + s * values[j, i + 1]
    bottom = (1 - s) * values[j + 1, i] + s * values[j + 1, i + 1]
    return np.where(inside[..., None], (1 - t) * top + t * bottom, np.nan)


MIN_MATCHES = 20


def measured_row_error(images: Sequence[np.ndarray], geometry: ArrayGeometry) -> float:
    """Median |dy| in px between matches of neighbouring rectified images and the row W_k predicts for them.

    images: K uint8 [H, W] or [H, W, 3] rectified views; see matching.neighbour_matches. The measurement's own noise
    is some hundredths of a pixel. NaN if fewer than MIN_MATCHES matches are found (untextured or dark images).
    """
    errors = np.concatenate([matches.row_error for matches in neighbour_matches(images, geometry)])
    return float(np.median(abs(errors))) if len(errors) >= MIN_MATCHES else float("nan")
