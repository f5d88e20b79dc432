"""seepast: see past people with a camera array.

import seepast
rig = seepast.Rig.from_kalibr("rig.yaml")
result = seepast.reconstruct(images, masks, rig)   # arrays in, arrays out
for result in seepast.stream(frames, rig): ...     # frames: any iterable of (images, masks)
"""

from .errors import SeepastError
from .options import Options
from .pipeline import Reconstructor, reconstruct, stream
from .result import Result
from .rig import Camera, Rig

__version__ = "0.1.0"
__all__ = ["Camera", "Options", "Reconstructor", "Result", "Rig", "SeepastError", "reconstruct", "stream"]
