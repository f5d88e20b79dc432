"""Tables that turn P(dynamic) into energies and energies back into P(dynamic), shared by all backends.

They are computed once here and handed to every backend, so that no two math libraries can disagree.
"""

from __future__ import annotations

import numpy as np

from .options import SegmentationOptions

NATS = 1024  # prior costs are whole 1024ths of a nat: every backend adds them up exactly
UNCHANGED = 255  # in a posterior: this ray's label is the one its prior suggested
_FINE = 16  # the posterior is tabulated in 16ths of a nat ...
_REACH = 16  # ... up to 16 nats either way


def prior_costs(options: SegmentationOptions) -> np.ndarray:
    """-log p(S | S_P) for P(dynamic) = 0 .. 254 (of 254): int32 [2, 255], row S, in 1024ths of a nat."""
    p = np.clip(np.arange(255) / 254, options.floor, 1 - options.floor)
    nats = np.stack([options.outlier_cost - np.log(p), -np.log(1 - p)])
    return np.round(NATS * nats).astype(np.int32)


POSTERIOR = np.floor(254 / (1 + np.exp(np.arange(-_REACH * _FINE, _REACH * _FINE + 1) / _FINE)) + 0.5).astype(np.uint8)


POSTERIOR_SCALE = _FINE / NATS  # entries of POSTERIOR per unit of energy; its middle entry is no evidence either way


def posterior_index(energy_gain: np.ndarray) -> np.ndarray:
    """Index into POSTERIOR of E(ray dynamic) - E(ray static), given in 1024ths of a nat."""
    fine = np.floor(energy_gain * POSTERIOR_SCALE + 0.5)
    return (np.clip(fine, -_REACH * _FINE, _REACH * _FINE) + _REACH * _FINE).astype(np.int32)
