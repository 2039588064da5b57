"""Moving pictures of episodes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from marl_sched.errors import InvalidOptionError
from marl_sched.files import replacing

_COLOURS = 64  # of the palette that all frames share, so that what does not move does not flicker


def save_animation(path: Path, frames: Iterable[np.ndarray], *, seconds: float = 0.1) -> None:
    """Write frames, uint8 (H, W, 3) of one size, as an endless GIF that shows each for so long, whole or not at all.

    Raises InvalidOptionError where there are no frames, ModuleNotFoundError without Pillow.
    """
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    if not images:
        raise InvalidOptionError(f"{path}: expected at least one frame")
    palette = images[len(images) // 2].quantize(_COLOURS)
    first, *others = [image.quantize(_COLOURS, palette=palette, dither=Image.Dither.NONE) for image in images]
    with replacing(path) as temporary:
        first.save(
            temporary, format="GIF", save_all=True, append_images=others, duration=round(1000 * seconds), loop=0,
            optimize=False,
        )  # fmt: skip
