"""`seepast synth`: array recordings made by ray casting, with everything about them known.

    from seepast.synth import generate
    generate("recording", "rig.yaml", frames=10, seed=1, masks="network")

mesh, textures, figures, room: what there is to see; render: rays in, colours out; masks: how segmenters err;
views: the cameras, and truth; record: sensors and files.
"""

from .masks import KINDS
from .record import depths, generate

__all__ = ["KINDS", "depths", "generate"]
