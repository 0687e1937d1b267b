"""Every file that somebody else may hand us, mutated: each reader must answer with a value or with one line.

    for target in targets(folder): outcome = fuzz(target, rounds, seed)

A mutation flips, cuts, repeats, swaps or overwrites bytes of a valid file; where it stands for text, also by words that mean
something to a parser. Draws are functions of (seed, round): a failure is found again by its number.
"""

import json
import random
import re
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from ..datamanagers.images import load_image
from ..datamanagers.parsers.config import ColmapConfig, LlffConfig, TransformsConfig
from ..engine import tensorfiles
from ..errors import FprfError
from ..plugins.codec import load_config
from ..rendering.camera_path import read_camera_path
from ..style.dictionary import load_dictionary, save_dictionary
from ..style.files import read_style
from ..testing import cases

__all__ = ["Outcome", "Target", "fuzz", "mutated", "targets"]

SIDE = 24
WORDS = (b"NaN", b"1e400", b"-1", b"0", b"null", b"true", b"[]", b"{}", b"../../etc/passwd", b"\x00", b"\xff\xfe", b"9" * 40)
VALUES = (b"0", b"-1", b"1e300", b"1e-300", b"null", b'"x"', b"[]", b"{}", b"true", b"0.5", b"65536", b"1e999", b"123456789012")
"""What stands in the place of a number of a text."""
_NUMBER = re.compile(rb"-?\d+(\.\d+)?")
NUMBERS = tuple(struct.pack("<Q", value) for value in (0, 1, 2**28, 2**31, 2**63, 2**64 - 1))
NUMBERS += tuple(struct.pack("<d", value) for value in (0.0, -1.0, 1e300, float("nan"), float("inf")))


class Target(NamedTuple):
    """A reader and a valid file for it."""

    name: str
    file: Path
    """What is mutated; its folder holds whatever else the reader needs."""
    read: Callable[[], object]


class Outcome(NamedTuple):
    """What came of some rounds."""

    rounds: int
    values: int
    refusals: int
    """Errors of ours, of one line."""
    faults: tuple[str, ...]
    """Anything else, by round."""
    slowest: float
    """Seconds of the longest round."""
    memory: int
    """Most bytes that Python held at once in a round, where it was watched; 0 otherwise."""


def mutated(data: bytes, draw: random.Random) -> bytes:
    """The bytes with one to four harms, mostly one."""
    raw = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        at, kind = draw.randrange(len(raw) + 1), draw.randrange(9)
        if kind > 6 and (found := list(_NUMBER.finditer(raw))):
            start, stop = draw.choice(found).span()
            raw[start:stop] = draw.choice(VALUES)
        elif kind == 0 and raw:
            raw[at % len(raw)] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del raw[at:]
        elif kind == 2:
            raw[at : at + 8] = draw.choice(NUMBERS)
        elif kind == 3:
            raw[at:at] = draw.choice(WORDS)
        elif kind == 4:
            raw[at : at + draw.randint(1, 9)] = draw.choice(WORDS)
        elif kind == 5:
            raw[at:at] = raw[at : at + draw.randint(1, 64)] * draw.randint(1, 4)
        else:
            del raw[at : at + draw.randint(1, 64)]
    return bytes(raw)


def fuzz(target: Target, rounds: int, seed: int, *, watch_memory: bool = False) -> Outcome:
    """Read `rounds` mutations of the target's file, which is put back at the end."""
    whole = target.file.read_bytes()
    values = refusals = memory = 0
    slowest, faults = 0.0, []
    try:
        for number in range(rounds):
            draw = random.Random(f"{target.name} {seed} {number}")  # nosec B311  # no secrets
            target.file.write_bytes(mutated(whole, draw))
            if watch_memory:
                tracemalloc.start()
            start = time.perf_counter()
            try:
                target.read()
                values += 1
            except FprfError as error:
                refusals += 1
                if "\n" in str(error):
                    faults.append(f"{number}: more than one line: {error!r}")
            except Exception as error:
                faults.append(f"{number}: {error!r}"[:300])
            slowest = max(slowest, time.perf_counter() - start)
            if watch_memory:
                memory = max(memory, tracemalloc.get_traced_memory()[1])
                tracemalloc.stop()
    finally:
        target.file.write_bytes(whole)
    return Outcome(rounds, values, refusals, tuple(faults), slowest, memory)


def targets(folder: Path) -> list[Target]:
    """One for each kind of file, written into `folder`."""
    found = [*_colmap(folder / "colmap", binary=True), *_colmap(folder / "colmap-text", binary=False)]
    found += [_transforms(folder / "transforms"), _llff(folder / "llff")]
    found += [_image(folder / "images", suffix) for suffix in ("png", "jpg", "webp", "bmp", "tiff")]
    found += [_camera_path(folder / "paths"), _style(folder / "styles"), _config(folder / "configs")]
    return [*found, *_tensors(folder / "tensors")]


def _pictures(folder: Path, count: int) -> list[str]:
    folder.mkdir(parents=True)
    names = [f"{k}.png" for k in range(count)]
    for k, name in enumerate(names):
        _paint(folder / name, k)
    return names


def _paint(path: Path, seed: int) -> None:
    pixels = np.random.default_rng(seed).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())


def _colmap(folder: Path, *, binary: bool) -> list[Target]:
    names = _pictures(folder / "images", 3)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    suffix = "bin" if binary else "txt"
    for kind, data in (_colmap_binary if binary else _colmap_text)(names).items():
        (model / f"{kind}.{suffix}").write_bytes(data)
    parser = ColmapConfig().build()
    return [
        Target(f"COLMAP {kind}.{suffix}", model / f"{kind}.{suffix}", lambda: parser.parse(folder, 1))
        for kind in ("cameras", "images", "points3D")
    ]


def _colmap_binary(names: list[str]) -> dict[str, bytes]:
    cameras = struct.pack("<Q", 1) + struct.pack("<IiQQ", 1, 1, SIDE, SIDE) + struct.pack("<4d", 30, 30, SIDE / 2, SIDE / 2)
    images = struct.pack("<Q", len(names))
    for k, name in enumerate(names):
        images += struct.pack("<I7dI", k + 1, 1, 0, 0, 0, 0.3 * k, 0, 0, 1) + name.encode() + b"\0"
        images += struct.pack("<Q", 12) + b"".join(struct.pack("<ddq", 3, 4, point) for point in range(12))
    points = struct.pack("<Q", 12)
    for k in range(12):
        points += struct.pack("<Q3d3Bd", k, k % 3 - 1.0, k % 4 - 1.5, 4 + 0.2 * k, 1, 2, 3, 0.5) + struct.pack("<QII", 1, 1, k)
    return {"cameras": cameras, "images": images, "points3D": points}


def _colmap_text(names: list[str]) -> dict[str, bytes]:
    cameras = f"# a comment\n1 PINHOLE {SIDE} {SIDE} 30 30 {SIDE / 2} {SIDE / 2}\n"
    features = " ".join(f"3 4 {point}" for point in range(12))
    images = "".join(f"{k + 1} 1 0 0 0 {0.3 * k} 0 0 1 {name}\n{features}\n" for k, name in enumerate(names))
    points = "".join(f"{k} {k % 3 - 1} {k % 4 - 1.5} {4 + 0.2 * k} 1 2 3 0.5 1 {k}\n" for k in range(12))
    return {"cameras": cameras.encode(), "images": images.encode(), "points3D": points.encode()}


def _transforms(folder: Path) -> Target:
    frames = []
    for k, name in enumerate(_pictures(folder / "images", 3)):
        pose = [[1, 0, 0, 0.3 * k], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose, "near": 1.0, "far": 9.0})
    document = {"w": SIDE, "h": SIDE, "fl_x": 30.0, "fl_y": 30.0, "cx": SIDE / 2, "cy": SIDE / 2, "k1": 0.01, "frames": frames}
    file = folder / "transforms.json"
    file.write_text(json.dumps(document))
    parser = TransformsConfig().build()
    return Target("transforms.json", file, lambda: parser.parse(folder, 1))


def _llff(folder: Path) -> Target:
    names = _pictures(folder / "images", 3)
    rows = np.zeros((len(names), 17))
    for k, row in enumerate(rows):
        row[:15] = np.array([[0, 1, 0, 0.3 * k, SIDE], [-1, 0, 0, 0, SIDE], [0, 0, 1, 0, 30]]).ravel()
        row[15:] = 1, 9
    np.save(folder / "poses_bounds.npy", rows)
    parser = LlffConfig().build()
    return Target("poses_bounds.npy", folder / "poses_bounds.npy", lambda: parser.parse(folder, 1))


def _image(folder: Path, suffix: str) -> Target:
    folder.mkdir(exist_ok=True)
    file = folder / f"picture.{suffix}"
    _paint(file, 0)
    return Target(f"image, {suffix}", file, lambda: load_image(file))


def _camera_path(folder: Path) -> Target:
    folder.mkdir()
    file = folder / "path.json"
    frames = [{"camera_to_world": [1, 0, 0, k, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 60, "aspect": 1} for k in range(3)]
    file.write_text(json.dumps({"camera_type": "perspective", "render_width": 9, "render_height": 9, "camera_path": frames}))
    return Target("camera path", file, lambda: read_camera_path(file))


def _style(folder: Path) -> Target:
    folder.mkdir()
    file = folder / "style.json"
    _paint(folder / "a.png", 0)
    file.write_text(json.dumps({"format": 1, "style": {"references": ["a.png"], "strength": 0.5, "clusters": 4}}))
    return Target("style.json", file, lambda: read_style(file))


def _config(folder: Path) -> Target:
    from ..methods import fprf_lite
    from ..plugins.codec import save_config

    folder.mkdir()
    save_config(folder / "config.json", fprf_lite(), "fprf-lite")
    return Target("config.json", folder / "config.json", lambda: load_config(folder / "config.json"))


def _tensors(folder: Path) -> list[Target]:
    folder.mkdir()
    sealed, codes = folder / "style.safetensors", folder / "dictionary.safetensors"
    tensorfiles.save_sealed(sealed, {"mean": torch.arange(6.0), "keys": torch.ones(3, 4)})
    save_dictionary(codes, cases.dictionary(3, 4, 2))
    return [
        Target("sealed tensors", sealed, lambda: tensorfiles.load_sealed(sealed)),
        Target("style dictionary", codes, lambda: load_dictionary(codes)),
    ]
