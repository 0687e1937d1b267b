"""Photographs as phones write them: with an EXIF orientation, and as HEIC."""

import base64
import io
import struct
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

HEIC = base64.b64decode(
    "AAAAHGZ0eXBoZWljAAAAAG1pZjFoZWljbWlhZgAAAchtZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAAAAAAAAAAADRpbG9jAAAAAERA"
    "AAIAAQAAAAAB7AABAAAAAAAAAJkAAgAAAAAChQABAAAAAAAAADgAAAA4aWluZgAAAAAAAgAAABVpbmZlAgAAAAABAABodmMxAAAAABVpbmZlAgAAAQAC"
    "AABFeGlmAAAAAA5waXRtAAAAAAABAAABB2lwcnAAAADmaXBjbwAAAHZodmNDAQNwAAAAkAAAAAAAHvAA/P34+AAADwNgAAEAGEABDAH//wNwAAADAJAA"
    "AAMAAAMAHroCQGEAAQAqQgEBA3AAAAMAkAAAAwAAAwAeoCCBBZbq5Ka5uAhoMCAAAAMDIAAAAwAhYgABAAZEAcFzwIkAAAATY29scm5jbHgAAQANAAaA"
    "AAAAFGlzcGUAAAAAAAAAQAAAAEAAAAAoY2xhcAAAAEAAAAABAAAAMAAAAAEAAAAAAAAAAv////AAAAACAAAAEHBpeGkAAAAAAwgICAAAAAlpcm90AwAA"
    "ABlpcG1hAAAAAAAAAAEAAQaBAgMFhIYAAAAaaXJlZgAAAAAAAAAOY2RzYwACAAEAAQAAANltZGF0AAAAlSgBrwngOSMkv//5BH//+MRuQ/Ys14W+nHoV"
    "P5J//VF3/pfM5N/c9A7/2StTwri/YL7zbGwV03GhpGtSnR4tvDQofSXzJxVRLrldJ0LAAfW2scgEdL/VHKDbixY+cn3+2DgyDWfYnewV3ef7HUVl74dV"
    "D0L/eaGTFLfe4BICqBta62eaBnmoFA3RO/X81REUrbr7NtkYAAAABkV4aWYAAE1NACoAAAAIAAIBEAACAAAACAAAACYBEgADAAAAAQAGAAAAAAAAUGhv"
    "bmUgOQA="
)
"""64 x 48 pixels stored, red on the left, green over blue on the right, rotated upright by the format
(`irot`) as by its EXIF orientation 6: it shows 48 x 64, red above, blue left of green below. Model "Phone
9".
"""


def exif_block(orientation: int) -> bytes:
    """An EXIF block of a JPEG that says nothing else."""
    return b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def turned_jpeg(path: Path, stored: np.ndarray, orientation: int) -> np.ndarray:
    """Write BGR pixels as a JPEG with an orientation; what it shows upright, RGB [H W 3], as decoders deliver
    it.
    """
    plain = bytes(cv2.imencode(".jpg", stored)[1])
    exif = exif_block(orientation)
    path.write_bytes(plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:])
    pixels = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    return upright(pixels, orientation)


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Stored pixels [H W C] as they are shown: EXIF 2.3, tag 0x0112, says where the first row and column
    belong.
    """
    turns = {2: pixels[:, ::-1], 3: pixels[::-1, ::-1], 4: pixels[::-1]}
    columns = {5: pixels, 6: pixels[::-1], 7: pixels[::-1, ::-1], 8: pixels[:, ::-1]}
    shown = (
        columns[orientation].transpose(1, 0, 2) if orientation in columns else turns.get(orientation, pixels)
    )
    return np.ascontiguousarray(shown)


def oriented(image: Image.Image, form: str, orientation: int, **options: object) -> bytes:
    """The file of an image with an EXIF orientation."""
    exif = Image.Exif()
    out = io.BytesIO()
    exif[0x0112] = orientation
    where = {"tiffinfo": {0x0112: orientation}} if form == "TIFF" else {"exif": exif}
    image.save(out, form, **where, **options)
    return out.getvalue()
