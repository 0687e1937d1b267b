"""Names of pictures that belong to a photograph: its masks, maps of it, thumbnails.

Names are compared by their spelling: in Unicode's normal form (macOS), without case and outer blanks.
"""

import re
import unicodedata
from collections.abc import Iterator

from .images import IMAGE_SUFFIXES

_SEPARATORS = r"[\s_.\-]*"
_SUBJECTS = r"(?:people|persons?|humans?|objects?|dynamic|static|binary|fg|foreground)"
MASK_WORDS = rf"(?:(?:{_SUBJECTS}{_SEPARATORS})?(?:masks?|msk|seg|segmentation|matte|alpha))"
"""A pattern of the words that tell a mask from its photograph, in 0001_mask.png or mask_0001.png."""
SKY_WORDS = rf"(?:sky(?:{_SEPARATORS}masks?)?|masks?)"
"""The same of masks of sky."""
MAP_WORDS = rf"(?:{MASK_WORDS}|{SKY_WORDS}|depths?|disparity|normals?|semantics?|confidence)"
"""The same of all masks and of maps."""
THUMBNAIL_WORDS = r"(?:thumbs?|thumbnails?|tn|previews?|small|\d+x\d+)"
"""The same of thumbnails."""
_CAMERA_WORDS = re.compile(rf"(?:rgb|images?|img|frames?|colou?r|photo|picture|pic|view){_SEPARATORS}(?=.)")
_LAST_NUMBER = re.compile(r"[\s_.\-]+\d+$")


def spelling(name: str) -> str:
    """The form in which names are compared."""
    return unicodedata.normalize("NFC", name).casefold().strip()


def without_suffixes(name: str) -> Iterator[str]:
    """A spelled name without its suffix, and while that ends with the suffix of an image, without that too."""
    while True:
        stem, _, suffix = name.rpartition(".")
        if not stem or f".{suffix}" not in IMAGE_SUFFIXES:
            return
        yield stem
        name = stem


def numbered(stem: str) -> str:
    """A spelled stem without a word that any camera or program writes first: frame_0012 is 0012."""
    if _CAMERA_WORDS.match(stem):
        return _CAMERA_WORDS.sub("", stem, count=1)
    return stem


def without_words(stem: str, words: str) -> Iterator[str]:
    """Rest of a spelled stem without words before or behind it, and numbers about those: of
    a_0_mask_1 that is a_0, then a. Nothing where it has none of the words.
    """
    behind = re.fullmatch(rf"(.+?){_SEPARATORS}{words}(?:{_SEPARATORS}\d+)*", stem)
    if behind:
        yield behind[1]
        shorter = _LAST_NUMBER.sub("", behind[1])
        if shorter and shorter != behind[1]:
            yield shorter
    before = re.fullmatch(rf"{words}{_SEPARATORS}(.+)", stem)
    if before:
        yield before[1]
