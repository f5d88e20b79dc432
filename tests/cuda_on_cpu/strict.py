"""A stand-in for CuPy that is as strict: arrays of the device never mix with NumPy's, nor become NumPy's unasked.

Only what the backend `cuda` uses of CuPy is here; new memory holds rubbish, so that what nobody wrote shows.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from .memory import guarded, guarded_copy

SCALARS = (bool, int, float, np.generic)


class Array(NDArrayOperatorsMixin):
    """An array of the device; its numbers are in `host`, which tests may look at and nobody else."""

    def __init__(self, host: np.ndarray):
        self.host = host

    shape, dtype, ndim, size, nbytes, itemsize, strides, flags = (
        property(lambda self, name=name: getattr(self.host, name))
        for name in ("shape", "dtype", "ndim", "size", "nbytes", "itemsize", "strides", "flags")
    )
    data = property(lambda self: SimpleNamespace(ptr=self.host.ctypes.data))
    T = property(lambda self: Array(self.host.T))

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray:
        raise TypeError("an array of the device does not become NumPy's by itself: download it")

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__":
            return NotImplemented
        out = tuple(_host(array) for array in kwargs.pop("out", ()))
        found = ufunc(*(_host(value) for value in inputs), **kwargs, **({"out": out} if out else {}))
        return Array(np.asarray(found))

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        own = getattr(xp, function.__name__, None)
        return NotImplemented if own is None else own(*args, **kwargs)

    def __len__(self) -> int:
        return len(self.host)

    def __iter__(self) -> Any:
        return (Array(part) for part in self.host)

    def __getitem__(self, key: Any) -> Array:
        return Array(np.asarray(self.host[_key(key)]))

    def __setitem__(self, key: Any, value: Any) -> None:
        self.host[_key(key)] = _host(value)

    def __bool__(self) -> bool:
        return bool(self.host)

    def __int__(self) -> int:
        return int(self.host)

    def __float__(self) -> float:
        return float(self.host)

    def __index__(self) -> int:
        return int(self.host)

    def astype(self, dtype: Any, copy: bool = True) -> Array:
        return Array(self.host.astype(dtype, copy=copy))

    def view(self, dtype: Any) -> Array:
        return Array(self.host.view(dtype))

    def reshape(self, *shape: Any) -> Array:
        return Array(self.host.reshape(*shape))


def _method(name: str) -> Any:
    return lambda self, *args, **kwargs: Array(np.asarray(getattr(self.host, name)(*args, **kwargs)))


for _name in ("all", "any", "copy", "max", "mean", "min", "ravel", "sum", "transpose"):
    setattr(Array, _name, _method(_name))


def _host(value: Any) -> Any:
    if isinstance(value, Array):
        return value.host
    if isinstance(value, SCALARS) or (isinstance(value, np.ndarray) and value.ndim == 0):
        return value
    raise TypeError(f"an array of the device meets {type(value).__name__}: upload that first")


def _key(key: Any) -> Any:
    if isinstance(key, tuple):
        return tuple(_key(part) for part in key)
    if isinstance(key, (slice, int, np.integer, type(None), type(...))):
        return key
    return _host(key)


def _new(shape: Any, dtype: Any = float) -> Array:
    return Array(guarded(shape, dtype))


def _filled(value: Any) -> Any:
    return lambda shape, dtype=float: Array(guarded_copy(np.full(shape, value, dtype)))


def _like(value: Any) -> Any:
    def like(array: Array, dtype: Any = None) -> Array:
        return Array(np.full_like(_host(array), value, dtype, subok=False))

    return like


def _wrapped(name: str) -> Any:
    def function(*args: Any, **kwargs: Any) -> Array:
        hosts = ([_host(part) for part in arg] if isinstance(arg, (list, tuple)) else _host(arg) for arg in args)
        return Array(np.asarray(getattr(np, name)(*hosts, **kwargs)))

    return function


def _asarray(value: Any, dtype: Any = None) -> Array:
    return value if isinstance(value, Array) and dtype in (None, value.dtype) else Array(np.array(_host(value), dtype))


xp: Any = SimpleNamespace(
    ndarray=Array,
    empty=_new,
    zeros=_filled(0),
    ones=_filled(1),
    full=lambda shape, value, dtype=None: Array(np.full(shape, value, dtype)),
    empty_like=lambda array, dtype=None: _new(array.shape, dtype or array.dtype),
    zeros_like=_like(0),
    ones_like=_like(1),
    full_like=lambda array, value, dtype=None: Array(np.full_like(_host(array), value, dtype)),
    arange=lambda *args, **kwargs: Array(np.arange(*args, **kwargs)),
    asarray=_asarray,
    ascontiguousarray=lambda array: Array(np.ascontiguousarray(_host(array))),
    broadcast_to=lambda array, shape: Array(np.broadcast_to(_host(array), shape)),
    may_share_memory=lambda a, b: np.may_share_memory(_host(a), _host(b)),
    where=_wrapped("where"),
    stack=lambda arrays, axis=0: Array(np.stack([_host(array) for array in arrays], axis)),
)
