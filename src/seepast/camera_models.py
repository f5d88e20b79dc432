"""The camera models that Kalibr writes: ray -> pixel and back, vectorised NumPy in float64.

Every model is three steps: the ray (X, Y, Z) -> a point m of the model's plane, a distortion m -> m', and the
pixel (fu * m'x + pu, fv * m'y + pv). Pixel centres lie at integer coordinates.

    model    intrinsics (Kalibr order)        plane point m
    pinhole  fu, fv, pu, pv                   (X, Y) / Z
    omni     xi, fu, fv, pu, pv               (X, Y) / (Z + xi * |ray|)                      Mei & Rives 2007
    ds       xi, alpha, fu, fv, pu, pv        (X, Y) / (alpha * d2 + (1 - alpha) * (xi * d1 + Z)),
                                              d1 = |ray|, d2 = |(X, Y, xi * d1 + Z)|        Usenko et al. 2018

    distortion   coefficients         m'
    none         (none, or zeros)     m
    radtan       k1, k2, p1, p2[, k3] Brown: as OpenCV's calib3d
    equidistant  k1, k2, k3, k4       pinhole only: theta * (1 + k1 theta^2 + ... + k4 theta^8) along (X, Y),
                                      theta the angle to the optical axis: as OpenCV's fisheye

Distortion polynomials stop being invertible at some radius; beyond it a calibration says nothing, and both
directions return NaN there instead of folding far rays back into the image.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .errors import RigError

PARAMETERS: dict[str, tuple[str, ...]] = {
    "pinhole": ("fu", "fv", "pu", "pv"),
    "omni": ("xi", "fu", "fv", "pu", "pv"),
    "ds": ("xi", "alpha", "fu", "fv", "pu", "pv"),
}
DISTORTIONS: dict[str, tuple[str, ...]] = {
    "pinhole": ("none", "radtan", "equidistant"),
    "omni": ("none", "radtan"),
    "ds": ("none",),
}
COEFFICIENTS: dict[str, tuple[int, ...]] = {"radtan": (4, 5), "equidistant": (4,)}

_NEWTON_STEPS = 25
_CONVERGED = 1e-11  # of the plane's unit: about 1e-8 px at any focal length in use


def check_model(
    name: str, model: str, distortion: str, intrinsics: Sequence[float], coefficients: Sequence[float]
) -> None:
    """Raise RigError, naming camera `name`, unless project and unproject can work with these parameters."""
    if model not in PARAMETERS:
        raise RigError(
            f"{name}: camera_model '{model}' is not supported (supported: {', '.join(PARAMETERS)}); "
            "calibrate again with one of these"
        )
    if distortion not in DISTORTIONS[model]:
        raise RigError(
            f"{name}: distortion_model '{distortion}' is not supported with camera_model '{model}' "
            f"(supported: {', '.join(DISTORTIONS[model])}); calibrate again with one of these"
        )
    names = PARAMETERS[model]
    if len(intrinsics) != len(names):
        raise RigError(
            f"{name}: intrinsics of a '{model}' camera are {len(names)} numbers ({', '.join(names)}), "
            f"not {len(intrinsics)}"
        )
    _check_coefficients(name, distortion, coefficients)
    if not np.isfinite([*intrinsics, *coefficients]).all():
        raise RigError(
            f"{name}: intrinsics or distortion_coeffs hold NaN or infinity: the calibration did not converge; repeat it"
        )
    _check_values(name, model, dict(zip(names, intrinsics, strict=True)))


def _check_coefficients(name: str, distortion: str, coefficients: Sequence[float]) -> None:
    if distortion == "none":
        if any(coefficients):
            raise RigError(
                f"{name}: distortion_model is 'none' but distortion_coeffs are {list(coefficients)}; "
                "name the distortion model or empty the list"
            )
    elif len(coefficients) not in COEFFICIENTS[distortion]:
        expected = " or ".join(str(n) for n in COEFFICIENTS[distortion])
        raise RigError(f"{name}: distortion_coeffs of '{distortion}' are {expected} numbers, not {len(coefficients)}")


def _check_values(name: str, model: str, value: dict[str, float]) -> None:
    if value["fu"] <= 0 or value["fv"] <= 0:
        raise RigError(
            f"{name}: focal lengths ({value['fu']:g}, {value['fv']:g}) must be positive: the intrinsic "
            f"matrix is singular; intrinsics are in the order {', '.join(PARAMETERS[model])}"
        )
    if model == "omni" and value["xi"] < 0:
        raise RigError(f"{name}: xi = {value['xi']:g} of an omni camera must not be negative")
    if model == "ds" and not (-1 < value["xi"] <= 1 and 0 <= value["alpha"] <= 1):
        raise RigError(
            f"{name}: a double sphere camera needs -1 < xi <= 1 and 0 <= alpha <= 1, not xi = "
            f"{value['xi']:g}, alpha = {value['alpha']:g}"
        )


def project(
    model: str,
    distortion: str,
    intrinsics: Sequence[float],
    coefficients: Sequence[float],
    points: np.ndarray,
) -> np.ndarray:
    """Points (..., 3) in the camera frame (x right, y down, z forward) -> pixels (..., 2) float64.

    NaN where the model cannot see the point: behind it, or beyond the radius where its distortion is
    invertible. Pixels outside the image are returned as they are.
    """
    points = np.asarray(points, np.float64)
    with np.errstate(all="ignore"):
        if distortion == "equidistant":
            plane = _equidistant_plane(coefficients, points)
        else:
            plane = _plane(model, intrinsics, points)
            if distortion == "radtan":
                plane = _radtan_distort(coefficients, plane)
    focal, center = _affine(intrinsics)
    return plane * focal + center


def unproject(
    model: str,
    distortion: str,
    intrinsics: Sequence[float],
    coefficients: Sequence[float],
    pixels: np.ndarray,
) -> np.ndarray:
    """Pixels (..., 2) -> unit rays (..., 3) float64 in the camera frame; NaN where no ray projects there.

    The inverse of `project`: distortions by Newton's method to about 1e-8 px, models in closed form.
    """
    focal, center = _affine(intrinsics)
    plane = (np.asarray(pixels, np.float64) - center) / focal
    with np.errstate(all="ignore"):
        if distortion == "equidistant":
            return _equidistant_ray(coefficients, plane)
        if distortion == "radtan":
            plane = _radtan_undistort(coefficients, plane)
        return _ray(model, intrinsics, plane)


def _affine(intrinsics: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    fu, fv, pu, pv = intrinsics[-4:]
    return np.array([fu, fv]), np.array([pu, pv])


def _plane(model: str, intrinsics: Sequence[float], points: np.ndarray) -> np.ndarray:
    z = points[..., 2]
    if model == "pinhole":
        denominator, visible = z, z > 0
    else:
        distance = np.linalg.norm(points, axis=-1)
        xi = intrinsics[0]
        if model == "omni":
            denominator = z + xi * distance
            visible = z > -(min(xi, 1 / xi) if xi else 0.0) * distance
        else:
            alpha = intrinsics[1]
            shifted = xi * distance + z
            second = np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + shifted**2)
            denominator = alpha * second + (1 - alpha) * shifted
            visible = z > -_ds_limit(xi, alpha) * distance
    visible = visible & (denominator > 0)
    return points[..., :2] / np.where(visible, denominator, np.nan)[..., None]


def _ds_limit(xi: float, alpha: float) -> float:
    """w2 of Usenko et al. 2018, eq. 43-45: a double sphere sees z > -w2 * |ray|."""
    w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    return (w1 + xi) / float(np.sqrt(2 * w1 * xi + xi**2 + 1))


def _ray(model: str, intrinsics: Sequence[float], plane: np.ndarray) -> np.ndarray:
    r2 = (plane**2).sum(-1)
    if model == "pinhole":
        rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
    elif model == "omni":
        xi = intrinsics[0]
        scale = (xi + np.sqrt(1 + (1 - xi**2) * r2)) / (1 + r2)
        rays = np.concatenate([plane * scale[..., None], (scale - xi)[..., None]], axis=-1)
    else:
        xi, alpha = intrinsics[:2]
        mz = (1 - alpha**2 * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
        scale = (mz * xi + np.sqrt(mz**2 + (1 - xi**2) * r2)) / (mz**2 + r2)
        rays = np.concatenate([plane * scale[..., None], (scale * mz - xi)[..., None]], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _first_extremum(derivative: Sequence[float]) -> float:
    """Smallest positive s with 1 + c1 s + c2 s^2 + ... = 0 (a derivative's zero); infinity if none."""
    roots = np.roots([*reversed(derivative), 1.0])
    real = roots.real[(abs(roots.imag) < 1e-9 * (1 + abs(roots))) & (roots.real > 0)]
    return float(real.min()) if real.size else np.inf


def _radtan_limit(coefficients: Sequence[float]) -> float:
    """Squared radius at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing."""
    k1, k2, _, _, k3 = (*coefficients, 0.0)[:5]
    return _first_extremum([3 * k1, 5 * k2, 7 * k3])


def _radtan_terms(
    coefficients: Sequence[float], x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * (3 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return u, v, radial, slope


def _radtan_distort(coefficients: Sequence[float], plane: np.ndarray) -> np.ndarray:
    x, y = plane[..., 0], plane[..., 1]
    u, v, _, _ = _radtan_terms(coefficients, x, y)
    inside = x * x + y * y < _radtan_limit(coefficients)
    return np.where(inside[..., None], np.stack([u, v], axis=-1), np.nan)


def _radtan_undistort(coefficients: Sequence[float], plane: np.ndarray) -> np.ndarray:
    p1, p2 = coefficients[2:4]
    limit = _radtan_limit(coefficients)
    target_x, target_y = plane[..., 0], plane[..., 1]
    x, y = _inside_radius(target_x, target_y, limit)
    for _ in range(_NEWTON_STEPS):
        u, v, radial, slope = _radtan_terms(coefficients, x, y)
        eu, ev = u - target_x, v - target_y
        error = np.hypot(eu, ev)
        if not (error > _CONVERGED / 100).any():
            break
        xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        determinant = xx * yy - xy * xy
        x, y = _inside_radius(x - (yy * eu - xy * ev) / determinant, y - (xx * ev - xy * eu) / determinant, limit)
    u, v, _, _ = _radtan_terms(coefficients, x, y)
    solved = (np.hypot(u - target_x, v - target_y) < _CONVERGED) & (x * x + y * y < limit)
    return np.where(solved[..., None], np.stack([x, y], axis=-1), np.nan)


def _inside_radius(x: np.ndarray, y: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Pull points back inside the invertible disc: Newton must not jump over the turning point."""
    if not np.isfinite(limit):
        return x, y
    shrink = np.minimum(1, 0.999 * np.sqrt(limit) / np.maximum(np.hypot(x, y), 1e-300))
    return x * shrink, y * shrink


def _equidistant_limit(coefficients: Sequence[float]) -> float:
    """Largest angle to the optical axis up to which the distorted angle grows, at most pi."""
    slope = [(2 * i + 3) * k for i, k in enumerate(coefficients)]
    return float(min(np.sqrt(_first_extremum(slope)), np.pi))


def _equidistant_angle(coefficients: Sequence[float], theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distorted angle and its derivative."""
    k1, k2, k3, k4 = coefficients
    t2 = theta * theta
    value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return value, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def _equidistant_plane(coefficients: Sequence[float], points: np.ndarray) -> np.ndarray:
    radius = np.hypot(points[..., 0], points[..., 1])
    theta = np.arctan2(radius, points[..., 2])
    distorted, _ = _equidistant_angle(coefficients, theta)
    # On the axis the direction is undefined and the angle is zero, so any finite quotient serves.
    scale = np.where(radius > 0, distorted / np.where(radius > 0, radius, 1), 0.0)
    seen = (theta < _equidistant_limit(coefficients)) & np.isfinite(radius)
    return np.where(seen[..., None], points[..., :2] * scale[..., None], np.nan)


def _equidistant_ray(coefficients: Sequence[float], plane: np.ndarray) -> np.ndarray:
    limit = _equidistant_limit(coefficients)
    target = np.hypot(plane[..., 0], plane[..., 1])
    theta = np.minimum(target, 0.999 * limit)
    for _ in range(_NEWTON_STEPS):
        value, slope = _equidistant_angle(coefficients, theta)
        if not (abs(value - target) > _CONVERGED / 100).any():
            break
        theta = np.clip(theta - (value - target) / slope, 0, 0.999 * limit)
    value, _ = _equidistant_angle(coefficients, theta)
    theta = np.where((abs(value - target) < _CONVERGED) & (theta < limit), theta, np.nan)
    scale = np.where(target > 0, np.sin(theta) / np.where(target > 0, target, 1), 1.0)
    return np.concatenate([plane * scale[..., None], np.cos(theta)[..., None]], axis=-1)
