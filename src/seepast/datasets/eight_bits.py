"""Images of 16 bits per channel as images of 8: round(255 v / (2^bits - 1)), and 255 for what is brighter.

One rule for all cameras and frames, since the method compares their grey levels. Nothing is stretched to what an image
happens to hold. `bits` are those that the cameras fill: 16, or less where their values lie in the lower bits.
"""

from __future__ import annotations

import functools
import logging

import numpy as np

from ..errors import OptionsError

log = logging.getLogger("seepast")

FULL = 16
DARK = FULL - 2  # an image that fills no more bits than that is black on the screen


@functools.lru_cache(maxsize=4)
def _table(bits: int) -> np.ndarray:
    """uint8[65536]: the grey level of every value. Raises OptionsError."""
    if not 8 <= bits <= FULL:
        raise OptionsError(f"--bits {bits}: images of 16 bits fill 8 to {FULL} of them; give that number")
    most = 2**bits - 1
    values = np.minimum(np.arange(2**FULL, dtype=np.int64), most)
    return ((2 * 255 * values + most) // (2 * most)).astype(np.uint8)


class EightBits:
    """Makes 8-bit images of 16-bit ones, and warns once where they are dark and nobody has said `bits`.

    bits  8 to 16; None = 16. Raises OptionsError.
    """

    def __init__(self, bits: int | None = None):
        self.bits = bits
        self._table = _table(FULL if bits is None else bits)
        self._told = bits is not None

    def __call__(self, where: object, image: np.ndarray) -> np.ndarray:
        """uint8 of uint16, the same shape; `where` names the image in the warning."""
        if not self._told:
            self._told = True
            filled = int(image.max(initial=0)).bit_length()
            if filled <= DARK:
                log.warning(
                    "%s: has 16 bits and fills %d of them, so it comes out dark; if the cameras give %d bits, say "
                    "--bits %d",
                    where, filled, max(filled, 10), max(filled, 10),
                )  # fmt: skip
        return self._table[image]
