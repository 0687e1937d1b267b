"""Pictures to bytes and files. A picture is a uint8 array [H W 3] in RGB; floats are sRGB in [0, 1]."""

import base64
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, overload

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import DataError, NumericsError
from .atomic import write_bytes

_Float = TypeVar("_Float", bound=np.floating)
Picture: TypeAlias = NDArray[np.uint8]
Format: TypeAlias = Literal["png", "jpg", "webp"]

_ENCODER_OPTIONS: dict[Format, list[int]] = {
    "png": [cv2.IMWRITE_PNG_COMPRESSION, 4],
    "jpg": [cv2.IMWRITE_JPEG_QUALITY, 92],
    "webp": [cv2.IMWRITE_WEBP_QUALITY, 84],
}
"""Settings of OpenCV's encoders: how much PNG is compressed (of 9), quality of the others (of 100); by eye."""
_PICTURE_ENDINGS: dict[str, Format] = {".png": "png", ".jpg": "jpg", ".jpeg": "jpg", ".webp": "webp"}


def to_uint8(image: Annotated[Tensor, "H W 3"]) -> Picture:
    """A float image as a picture, of any number of channels: clipped to [0, 1] and rounded. Raises
    NumericsError where a value is not finite.
    """
    pixels = image.detach().to("cpu", torch.float32)
    if not bool(torch.isfinite(pixels).all()):
        share = float((~torch.isfinite(pixels)).float().mean())
        raise NumericsError(
            f"an image of shape {tuple(image.shape)} has {share:.2%} values that are not finite"
        )
    # Half to even would move 0.5/255 steps unevenly; +0.5 and floor is what every image library does.
    pictured: Picture = (pixels.clamp(0, 1) * 255 + 0.5).to(torch.uint8).contiguous().numpy()
    return pictured


def checked(picture: Picture) -> Picture:
    """The picture itself, if it is one. Raises DataError."""
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or 0 in picture.shape:
        raise DataError(
            f"a picture must be uint8 of shape [H W 3]; found {picture.dtype} of shape {picture.shape}"
        )
    return picture


def encode(picture: Picture, form: Format) -> bytes:
    """The file of a picture, which may have straight alpha [H W 4] in PNG and WebP. PNG is exact; JPEG (92)
    and WebP (84) are for the eye.
    """
    if form != "jpg" and picture.shape[2:] == (4,):
        checked(picture[:, :, :3])
        swapped = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
    else:
        swapped = cv2.cvtColor(checked(picture), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(f".{form}", swapped, _ENCODER_OPTIONS[form])
    if not done:
        raise DataError(
            f"{form} cannot hold a picture of {picture.shape[1]}x{picture.shape[0]} pixels; use png"
        )
    return bytes(data.tobytes())


def data_uri(picture: Picture) -> str:
    """A picture as text that a page can hold: WebP."""
    return f"data:image/webp;base64,{base64.b64encode(encode(picture, 'webp')).decode('ascii')}"


def resized(picture: Picture, width: int, height: int) -> Picture:
    """The picture in another size: area-averaged where it gets smaller, bicubic where it gets larger."""
    if height < picture.shape[0] or width < picture.shape[1]:
        how = cv2.INTER_AREA
    else:
        how = cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, (width, height), interpolation=how), dtype=np.uint8)


def shrink(picture: Picture, side: int) -> Picture:
    """The picture with its longer side at most `side` pixels, area-averaged; never enlarged."""
    height, width = checked(picture).shape[:2]
    scale = side / max(height, width)
    if scale >= 1:
        return picture
    return resized(picture, max(1, round(width * scale)), max(1, round(height * scale)))


def write_image(path: Path, picture: Picture) -> None:
    """Write a picture, whole or not at all, in the format that the name ends with: .png .jpg .jpeg .webp. It
    may have alpha as that of `encode`.
    """
    form = _PICTURE_ENDINGS.get(path.suffix.lower())
    if form is None:
        raise DataError(
            f"{path}: '{path.suffix}' is no picture format; allowed are {' '.join(_PICTURE_ENDINGS)}"
        )
    write_bytes(path, encode(picture, form))


@overload
def srgb_to_linear(colour: Tensor) -> Tensor: ...
@overload
def srgb_to_linear(colour: NDArray[_Float]) -> NDArray[_Float]: ...
def srgb_to_linear(colour: Any) -> Any:
    """sRGB in [0, 1] as linear light (IEC 61966-2-1), an array or a tensor, in its own precision."""
    where: Any = torch.where if isinstance(colour, Tensor) else np.where
    return where(colour <= 0.04045, colour / 12.92, ((colour.clip(0) + 0.055) / 1.055) ** 2.4)
