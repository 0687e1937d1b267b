"""Colours of files whose tags say that they are not sRGB, and no profile does: each becomes what was meant."""

import io
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from fprf.datamanagers.image_files import colour_note
from fprf.datamanagers.images import load_image, load_mask
from fprf.errors import DataError
from fprf.io.transfer import BT709, DISPLAY_P3, PRIMARIES, Chromaticities, colour_space, rgb_to_xyz, to_srgb

RNG = np.random.default_rng(3)
# Large patches, so that what codecs lose at edges plays no part; no channel over the knee of tone mapping.
MEANT = (RNG.integers(20, 236, (4, 6, 3)) / 255).repeat(16, 0).repeat(16, 1)


def light_of(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_of(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)


def signal(primaries: Chromaticities, curve: int) -> np.ndarray:
    """The picture that is meant, in another colour space."""
    light = light_of(MEANT) @ (np.linalg.inv(rgb_to_xyz(primaries)) @ rgb_to_xyz(BT709)).T
    assert light.min() > -1e-6, "the wider gamut holds all"
    light = light.clip(0, None)
    if curve == 16:
        y = (light * 203 / 10000) ** (2610 / 16384)
        return ((3424 / 4096 + 2413 / 128 * y) / (1 + 2392 / 128 * y)) ** (2523 / 32)
    if curve == 18:
        e = light * 0.2649626
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        return np.where(e <= 1 / 12, (3 * e) ** 0.5, a * np.log(np.maximum(12 * e - b, 1e-9)) + c)
    if curve == 8:
        return light
    return srgb_of(light)


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def cicp(*values: int) -> bytes:
    return chunk(b"cICP", bytes(values))


def chrm(primaries: Chromaticities) -> bytes:
    red, green, blue, white = primaries
    values = [round(value * 100000) for pair in (white, red, green, blue) for value in pair]
    return chunk(b"cHRM", struct.pack(">8I", *values))


def gama(exponent: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(100000 / exponent)))


def png(values: np.ndarray, bits: int, *chunks: bytes) -> bytes:
    """A PNG of signals in [0, 1], with chunks behind its header."""
    whole = np.rint(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    data = bytes(cv2.imencode(".png", whole[:, :, ::-1] if whole.ndim == 3 else whole)[1])
    return data[:33] + b"".join(chunks) + data[33:]


def off(path: Path, meant: np.ndarray = MEANT) -> float:
    """Mean difference from what is meant, of 255: what 8 bits of the file round is large in single, dark
    channels of saturated colours.
    """
    return float(np.abs(load_image(path) - meant * 255).mean())


P3, BT2020 = DISPLAY_P3, PRIMARIES[9]
SPACES = [(12, 13), (9, 13), (9, 14), (9, 16), (9, 18), (12, 16), (1, 16), (9, 8), (2, 2)]


@pytest.mark.parametrize("codes", SPACES)
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("narrow", [False, True])
def test_cicp_of_png(tmp_path: Path, codes: tuple[int, int], bits: int, narrow: bool) -> None:
    values = signal(PRIMARIES.get(codes[0], BT709), codes[1])
    if narrow:
        values = (16 + 219 * values) * 2 ** (bits - 8) / (2**bits - 1)
    (tmp_path / "a.png").write_bytes(png(values, bits, cicp(*codes, 0, int(not narrow))))
    assert off(tmp_path / "a.png") <= {16: 0.3, 8: 1.5}[bits]
    space = colour_space(*codes)
    assert space is not None
    stored = np.rint(values * (2**bits - 1)) / (2 ** (bits - 8))
    exact = to_srgb(
        ((stored - 16) / 219 if narrow else stored * 2 ** (bits - 8) / (2**bits - 1)).clip(0, 1), space
    )
    assert np.abs(load_image(tmp_path / "a.png") - exact * 255).max() <= 0.56
    assert bool(colour_note(tmp_path / "a.png")) == (codes[1] in (16, 18))


def test_precedence_is_that_of_the_png_specification(tmp_path: Path) -> None:
    wide = signal(P3, 13)
    srgb_profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    iccp = chunk(b"iCCP", b"x\0\0" + zlib.compress(srgb_profile))
    srgb = chunk(b"sRGB", b"\0")
    p3 = cicp(12, 13, 0, 1)
    reserved = cicp(3, 13, 0, 1)
    with_matrix = cicp(12, 13, 9, 1)
    cases = {
        "cICP over iCCP": (p3, iccp),
        "cICP over sRGB": (p3, srgb),
        "cICP over cHRM": (p3, gama(1.0), chrm(BT709)),
        "cHRM alone": (chrm(P3),),
        "cHRM and gAMA of sRGB": (gama(2.2), chrm(P3)),
        "cHRM where cICP is reserved": (reserved, chrm(P3)),
        "cHRM where the profile is broken": (chunk(b"iCCP", b"x\0\0" + zlib.compress(b"nothing")), chrm(P3)),
    }
    for name, chunks in cases.items():
        (tmp_path / "a.png").write_bytes(png(wide, 8, *chunks))
        assert off(tmp_path / "a.png") <= 0.6, name
    plain = {
        "sRGB over cHRM": (srgb, gama(1.0), chrm(P3)),
        "iCCP over cHRM": (iccp, gama(1.0), chrm(P3)),
        "gAMA of sRGB": (gama(2.2),),
        "cHRM of sRGB": (gama(2.2), chrm(BT709)),
        "gAMA of 0": (chunk(b"gAMA", bytes(4)),),
        "cHRM that is no triangle": (chunk(b"cHRM", bytes(32)),),
        "reserved": (reserved,),
        "with a matrix": (with_matrix,),
        "too short": (chunk(b"cICP", b"\x0c\x0d\0"),),
    }
    for name, chunks in plain.items():
        (tmp_path / "a.png").write_bytes(png(MEANT, 8, *chunks))
        assert off(tmp_path / "a.png") <= 0.3, name
        assert bool(colour_note(tmp_path / "a.png")) == (name in ("reserved", "with a matrix")), name


def test_gamma_grey_palettes_and_transparency(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png(light_of(MEANT) ** (1 / 1.8), 16, gama(1.8)))
    assert off(path) <= 0.3
    grey = MEANT[:, :, 0]
    for bits, bound in ((8, 1.0), (16, 0.3)):
        path.write_bytes(png(light_of(grey), bits, gama(1.0)))
        assert off(path, grey[:, :, None]) <= bound
    # A mask's values are no colours.
    path.write_bytes(png(np.where(grey > 0.5, 0.6, 0.4), 8, gama(1.0)))
    assert np.array_equal(load_mask(path), grey > 0.5)
    wide = np.rint(signal(P3, 13) * 255).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(wide).quantize(64).save(out, "PNG")
    data = out.getvalue()
    path.write_bytes(data[:33] + cicp(12, 13, 0, 1) + data[33:])
    assert off(path) <= 0.6
    layers = np.dstack([wide[:, :, ::-1], np.full(wide.shape[:2], 128, np.uint8)])
    data = bytes(cv2.imencode(".png", layers)[1])
    path.write_bytes(data[:33] + cicp(12, 13, 0, 1) + data[33:])
    assert off(path, (MEANT * 128 + 127) / 255) <= 0.6


def tagged(data: bytes, primaries: int, curve: int) -> bytes:
    """An AVIF file with other code points in its nclx."""
    at = data.index(b"nclx") + 4
    return data[:at] + struct.pack(">HH", primaries, curve) + data[at + 4 :]


@pytest.mark.parametrize("codes", SPACES[:-2])
@pytest.mark.parametrize("bits", [8, 10, 12])
def test_nclx_of_avif(tmp_path: Path, codes: tuple[int, int], bits: int) -> None:
    values = signal(PRIMARIES[codes[0]], codes[1])
    whole = np.rint(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    options = [cv2.IMWRITE_AVIF_DEPTH, bits, cv2.IMWRITE_AVIF_QUALITY, 100, cv2.IMWRITE_AVIF_SPEED, 9]
    coded, data = cv2.imencode(".avif", whole[:, :, ::-1], options)
    assert coded
    (tmp_path / "a.avif").write_bytes(tagged(bytes(data), *codes))
    assert off(tmp_path / "a.avif") <= (0.5 if bits > 8 else 1.2)


@pytest.mark.parametrize("codes", SPACES[:-2])
@pytest.mark.parametrize("bits", [8, 10])
def test_nclx_of_heic(tmp_path: Path, codes: tuple[int, int], bits: int) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    values = signal(PRIMARIES[codes[0]], codes[1])
    if bits == 8:
        file = pillow_heif.from_pillow(Image.fromarray(np.rint(values * 255).astype(np.uint8)))
    else:
        deep = np.rint(values * 1023).astype(np.uint16) << 6
        file = pillow_heif.from_bytes(mode="RGB;16", size=deep.shape[1::-1], data=deep.tobytes())
    file.save(
        tmp_path / "a.heic",
        quality=100,
        chroma=444,
        color_primaries=codes[0],
        transfer_characteristics=codes[1],
        matrix_coefficients=9,
        full_range_flag=1,
    )
    assert off(tmp_path / "a.heic") <= (0.7 if bits > 8 else 2.5)


def test_a_profile_counts_before_nclx_and_reserved_codes_before_nothing(tmp_path: Path) -> None:
    whole = np.rint(MEANT * 255).astype(np.uint8)
    out = io.BytesIO()
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(whole).save(out, "AVIF", quality=100, subsampling="4:4:4", icc_profile=profile)
    (tmp_path / "a.avif").write_bytes(out.getvalue())
    plain = load_image(tmp_path / "a.avif")
    if b"nclx" in out.getvalue():
        (tmp_path / "a.avif").write_bytes(tagged(out.getvalue(), 9, 16))
        assert np.array_equal(load_image(tmp_path / "a.avif"), plain)
    out = io.BytesIO()
    Image.fromarray(whole).save(out, "AVIF", quality=100, subsampling="4:4:4")
    (tmp_path / "b.avif").write_bytes(tagged(out.getvalue(), 0, 3))
    assert off(tmp_path / "b.avif") <= 1
    assert "nclx 0/3" in colour_note(tmp_path / "b.avif")
    # Damage to the boxes leaves the pixels.
    data = out.getvalue()
    for at in range(0, data.index(b"mdat"), 3):
        (tmp_path / "b.avif").write_bytes(data[:at] + b"\xff" + data[at + 1 :])
        with suppress(DataError):
            load_image(tmp_path / "b.avif")


def test_adobe_rgb_of_cameras(tmp_path: Path) -> None:
    adobe = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), (0.3127, 0.329))
    light = light_of(MEANT) @ (np.linalg.inv(rgb_to_xyz(adobe)) @ rgb_to_xyz(BT709)).T
    values = np.rint(light.clip(0, None) ** (256 / 563) * 255).astype(np.uint8)
    for form, options in (("JPEG", {"quality": 100, "subsampling": 0}), ("WEBP", {"lossless": True})):
        Image.fromarray(values).save(tmp_path / "a", form, exif=adobe_exif(), **options)
        assert off(tmp_path / "a") <= 1, form
        Image.fromarray(values).save(tmp_path / "a", form, exif=adobe_exif(b"R98"), **options)
        assert np.abs(load_image(tmp_path / "a").astype(int) - values).max() <= 4, form


def adobe_exif(index: bytes = b"R03") -> bytes:
    """An EXIF block with an interoperability index, in the directory in which cameras write it."""
    first = struct.pack("<HHHIII", 1, 0x8769, 4, 1, 26, 0)
    inner = struct.pack("<HHHIHHHHIII", 2, 0xA001, 3, 1, 0xFFFF, 0, 0xA005, 4, 1, 56, 0)
    interop = struct.pack("<HHHI4sI", 1, 1, 2, 4, index + b"\0", 0)
    return b"Exif\0\0II*\0" + struct.pack("<I", 8) + first + inner + interop
