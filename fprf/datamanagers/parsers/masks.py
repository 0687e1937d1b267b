"""Which masks a capture has: files named after its images, in a folder beside theirs.

`masks/` says what is used (black is left out: people, cars, the capture's own shadow), `sky_masks/` what is sky (white). A mask
of images/a/0001.jpg is masks/a/0001.jpg.png (as COLMAP has it), masks/a/0001.png or masks/a/0001.jpg. Images without one are
used whole; a folder in which no mask carries an image's name is none.
"""

from collections.abc import Sequence
from pathlib import Path

__all__ = ["MASKS", "SKY_MASKS", "masks_beside"]

MASKS, SKY_MASKS = "masks", "sky_masks"
"""Names of the folders."""


def masks_beside(data: Path, images: Sequence[Path], name: str) -> tuple[Path | None, ...]:
    """The mask of each image, None where there is none; nothing at all where the capture has none of that name."""
    known: dict[Path, bool] = {}
    found = tuple(_mask(data, image, name, known) for image in images)
    return found if any(mask is not None for mask in found) else ()


def _mask(data: Path, image: Path, name: str, known: dict[Path, bool]) -> Path | None:
    """Beside the image's folder, or beside a folder around that, up to the scene's."""
    for above in image.parents[1:]:
        folder = above / name
        if folder not in known:
            known[folder] = folder.is_dir()
        if known[folder]:
            inner = folder.joinpath(*image.relative_to(above).parts[1:])
            for path in (inner.with_name(inner.name + ".png"), inner.with_suffix(".png"), inner):
                if path.is_file():
                    return path
        if above == data or not above.is_relative_to(data):
            return None
    return None
