"""The many-view stages on the GPU under the names of reference_multiview.py; arrays are the device's."""

from __future__ import annotations

from .cuda import fill_unseen
from .cuda_levels import (
    averaged,
    beside,
    clear_of_masks,
    copied,
    double_rows,
    enlarged,
    half_rows,
    inner_span,
    landings,
    mapped,
    three_channels,
    witnessed,
)
from .cuda_matching import (
    aggregate,
    aggregates,
    describe,
    everything,
    volume,
    volumes,
    windows,
    windows_of_views,
)
from .cuda_picture import blend, evidence, planes, planes_of_views, told
from .cuda_votes import graded_of_views, labels, votes, votes_of_views, witnesses

__all__ = [
    "aggregate",
    "aggregates",
    "averaged",
    "beside",
    "blend",
    "clear_of_masks",
    "copied",
    "describe",
    "double_rows",
    "enlarged",
    "everything",
    "evidence",
    "fill_unseen",
    "graded_of_views",
    "half_rows",
    "inner_span",
    "labels",
    "landings",
    "mapped",
    "planes",
    "planes_of_views",
    "three_channels",
    "told",
    "volume",
    "volumes",
    "votes",
    "votes_of_views",
    "windows",
    "windows_of_views",
    "witnessed",
    "witnesses",
]
