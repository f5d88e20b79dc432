"""Public networks that are known to do: a table. Another one is another line."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from ..errors import ModelError


@dataclass(frozen=True)
class PublicModel:
    """A network that anybody may fetch: what it is, its licence, address, size in bytes, SHA-256 and preset."""

    about: str
    licence: str
    address: str
    bytes: int
    sha256: str
    preset: str


OPENCV_ZOO = "https://github.com/opencv/opencv_zoo/raw/main/models"
MODELS: dict[str, PublicModel] = {
    "pphumanseg": PublicModel(
        "PP-HumanSeg 2023mar: people, 192x192, quick (OpenCV zoo, from PaddlePaddle)",
        "Apache-2.0",
        f"{OPENCV_ZOO}/human_segmentation_pphumanseg/human_segmentation_pphumanseg_2023mar.onnx",
        6163938,
        "552d8a984054e59b5d773d24b9b12022b22046ceb2bbc4c9aaeaceb36a9ddf24",
        "pphumanseg",
    ),
}


def models_folder() -> Path:
    """Where fetched models lie: $SEEPAST_MODELS, or seepast/models in the user's cache folder."""
    if chosen := os.environ.get("SEEPAST_MODELS"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", "~")).expanduser() / "seepast" / "models"
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "seepast" / "models"


def known_model(name: str) -> PublicModel:
    """Raises ModelError, listing what there is."""
    if name not in MODELS:
        raise ModelError(f"{name}: no such model; `seepast models` lists {', '.join(MODELS)}")
    return MODELS[name]


def find_model(name: str) -> tuple[Path, str | None]:
    """The file of a model and, where it is known, its preset; `name` is a file, or the name of a public model.

    Nothing is fetched. Raises ModelError where neither is there.
    """
    path = Path(name)
    if path.is_file():
        return path, None
    if name in MODELS:
        fetched = models_folder() / f"{name}.onnx"
        if fetched.is_file():
            return fetched, MODELS[name].preset
        raise ModelError(f"{name}: not fetched yet; say `seepast models get {name}` once")
    raise ModelError(f"{name}: no such file; name an ONNX file, or one of `seepast models`: {', '.join(MODELS)}")
