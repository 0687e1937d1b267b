"""A valid file of each kind that somebody else may hand us, with its reader: what `fuzz` mutates."""

import json
import random
import re
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from fprf.config_files import load_config
from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers.blocknerf import crc32c, masked, read_examples
from fprf.datamanagers.parsers.colmap_model import read_model
from fprf.datamanagers.parsers.config import (
    ColmapConfig,
    LlffConfig,
    MegaNerfConfig,
    OdmConfig,
    PolycamConfig,
    Record3DConfig,
    TransformsConfig,
)
from fprf.datamanagers.parsers.files import read_npz
from fprf.datamanagers.parsers.phototourism import read_list
from fprf.errors import FprfError
from fprf.io import tensorfiles
from fprf.rendering.paths import read_camera_path
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import Gaussians
from fprf.style.files import read_style
from fprf.testing import cases
from fprf.training import checkpoint

WHOLE_EVERY = 16
"""Rounds of which one is read to the end, where a reader of the bytes alone is known."""
WORDS = (
    b"NaN",
    b"1e400",
    b"-1",
    b"0",
    b"null",
    b"true",
    b"[]",
    b"{}",
    b"../../etc/passwd",
    b"\x00",
    b"\xff\xfe",
    b"9" * 40,
)
VALUES = (
    b"0",
    b"-1",
    b"1e300",
    b"1e-300",
    b"null",
    b'"x"',
    b"[]",
    b"{}",
    b"true",
    b"0.5",
    b"65536",
    b"1e999",
    b"123456789012",
)
"""Replacements of a number of a text."""
_NUMBER = re.compile(rb"-?\d+(\.\d+)?")
NUMBERS = tuple(struct.pack("<Q", value) for value in (0, 1, 2**28, 2**31, 2**63, 2**64 - 1))
NUMBERS += tuple(struct.pack("<d", value) for value in (0.0, -1.0, 1e300, float("nan"), float("inf")))


class Target(NamedTuple):
    """A reader and a valid file for it."""

    name: str
    file: Path
    """File that is mutated; its folder holds whatever else the reader needs."""
    read: Callable[[], object]
    """To the end: a scene, a config, pixels."""
    parse: Callable[[], object] | None = None
    """The bytes alone, where what follows takes most of the time."""


class Outcome(NamedTuple):
    """Outcome of some rounds."""

    rounds: int
    values: int
    refusals: int
    """Errors of ours, which are of one line (`FprfError`)."""
    faults: tuple[str, ...]
    """Anything else, by round."""
    slowest: float
    """Seconds of the processor for the longest round."""
    memory: int
    """Most bytes that Python held at once in a round, where it was watched; 0 otherwise."""


def mutated(data: bytes, draw: random.Random) -> bytes:
    """The bytes with one to four harms, mostly one."""
    raw = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        at = draw.randrange(len(raw) + 1)
        kind = draw.randrange(9)
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


def fuzz(
    target: Target, rounds: int, seed: int, *, first: int = 0, watch_memory: bool = False, quick: bool = False
) -> Outcome:
    """Read `rounds` mutations of the target's file, from number `first` on; the file is put back at the end.

    `quick` ones go to the reader of the bytes where there is one, and each sixteenth through to the end.
    """
    whole = target.file.read_bytes()
    values = refusals = memory = 0
    slowest = 0.0
    faults = []
    try:
        for number in range(first, first + rounds):
            draw = random.Random(f"{target.name} {seed} {number}")  # nosec B311  # no secrets
            target.file.write_bytes(mutated(whole, draw))
            if watch_memory:
                tracemalloc.start()
            start = time.process_time()
            try:
                (target.parse if quick and target.parse and number % WHOLE_EVERY else target.read)()
                values += 1
            except FprfError:
                refusals += 1
            except Exception as error:
                faults.append(f"{number}: {error!r}"[:300])
            slowest = max(slowest, time.process_time() - start)
            if watch_memory:
                memory = max(memory, tracemalloc.get_traced_memory()[1])
                tracemalloc.stop()
    finally:
        target.file.write_bytes(whole)
    return Outcome(rounds, values, refusals, tuple(faults), slowest, memory)


SIDE = 24


def targets(folder: Path) -> list[Target]:
    """One for each kind of file, written into `folder`."""
    found = [*_colmap(folder / "colmap", binary=True), *_colmap(folder / "colmap-text", binary=False)]
    found += [_transforms(folder / "transforms"), _llff(folder / "llff")]
    found += [_image(folder / "images", suffix) for suffix in ("png", "jpg", "webp", "bmp", "tiff")]
    found += [_camera_path(folder / "paths"), _style(folder / "styles"), _config(folder / "configs")]
    found += _tensors(folder / "tensors")
    found += [
        _checkpoint(folder / "checkpoints"),
        *_tables(folder / "tables"),
        _meganerf(folder / "meganerf"),
    ]
    found += [_polycam(folder / "polycam"), _record3d(folder / "record3d"), *_odm(folder / "odm")]
    return [*found, *_gaussians(folder / "gaussians")]


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
        Target(
            f"COLMAP {kind}.{suffix}",
            model / f"{kind}.{suffix}",
            lambda: parser.parse(folder, 1),
            lambda: read_model(model),
        )
        for kind in ("cameras", "images", "points3D")
    ]


def _colmap_binary(names: list[str]) -> dict[str, bytes]:
    cameras = (
        struct.pack("<Q", 1)
        + struct.pack("<IiQQ", 1, 1, SIDE, SIDE)
        + struct.pack("<4d", 30, 30, SIDE / 2, SIDE / 2)
    )
    images = struct.pack("<Q", len(names))
    for k, name in enumerate(names):
        images += struct.pack("<I7dI", k + 1, 1, 0, 0, 0, 0.3 * k, 0, 0, 1) + name.encode() + b"\0"
        images += struct.pack("<Q", 12) + b"".join(struct.pack("<ddq", 3, 4, point) for point in range(12))
    points = struct.pack("<Q", 12)
    for k in range(12):
        points += struct.pack(
            "<Q3d3Bd", k, k % 3 - 1.0, k % 4 - 1.5, 4 + 0.2 * k, 1, 2, 3, 0.5
        ) + struct.pack("<QII", 1, 1, k)
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
    document = {
        "w": SIDE,
        "h": SIDE,
        "fl_x": 30.0,
        "fl_y": 30.0,
        "cx": SIDE / 2,
        "cy": SIDE / 2,
        "k1": 0.01,
        "frames": frames,
    }
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
    frames = [
        {"camera_to_world": [1, 0, 0, k, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 60, "aspect": 1}
        for k in range(3)
    ]
    file.write_text(
        json.dumps(
            {"camera_type": "perspective", "render_width": 9, "render_height": 9, "camera_path": frames}
        )
    )
    return Target("camera path", file, lambda: read_camera_path(file))


def _style(folder: Path) -> Target:
    folder.mkdir()
    file = folder / "style.json"
    _paint(folder / "a.png", 0)
    file.write_text(
        json.dumps({"format": 1, "style": {"references": ["a.png"], "strength": 0.5, "clusters": 4}})
    )
    return Target("style.json", file, lambda: read_style(file))


def _config(folder: Path) -> Target:
    from fprf.config_files import save_config
    from fprf.methods import fprf_lite

    folder.mkdir()
    save_config(folder / "config.json", fprf_lite(), "fprf-lite")
    return Target("config.json", folder / "config.json", lambda: load_config(folder / "config.json"))


def _tensors(folder: Path) -> list[Target]:
    folder.mkdir()
    sealed = folder / "style.safetensors"
    tensorfiles.save(sealed, {"mean": torch.arange(6.0), "keys": torch.ones(3, 4)}, sealed=True)
    return [
        Target("sealed tensors", sealed, lambda: tensorfiles.load_sealed(sealed)),
    ]


def _checkpoint(folder: Path) -> Target:
    """The manifest as those before the checksum were: else nothing but the checksum would be tried."""
    step = folder / "step-0000003"
    tensors = {"planes": torch.arange(6.0).reshape(2, 3)}
    files = {name: tensorfiles.save(step / f"{name}.safetensors", tensors) for name in ("model", "optimizer")}
    file = step / "manifest.json"
    file.write_text(json.dumps({"format": 1, "step": 3, "seconds": 1.5, "files": files}))
    return Target("checkpoint manifest", file, lambda: checkpoint.load(folder, 3))


def _tables(folder: Path) -> list[Target]:
    """An archive of NumPy, a list of photographs, a record of TFRecord's (its checksums made to fit each
    mutation).
    """
    folder.mkdir()
    archive = folder / "points.npz"
    table = folder / "list.tsv"
    example = folder / "example"
    stream = BytesIO()
    np.save(stream, np.arange(12.0).reshape(4, 3))
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("points.npy", stream.getvalue())
    rows = (
        "filename\tid\tsplit\tdataset",
        "a.jpg\t1\ttrain\tx",
        "b.jpg\t2\ttest\tx",
        "c.jpg\t\ttrain\tx",
        "",
    )
    table.write_text("\n".join(rows))
    example.write_bytes(_example())
    return [
        Target("archive of arrays", archive, lambda: read_npz(archive, "points")),
        Target("list of photographs", table, lambda: read_list(table)),
        Target("tf.train.Example", example, lambda: _read_record(example)),
    ]


def _example() -> bytes:
    """Three features: a name, two floats, an integer."""

    def inner(number: int, data: bytes) -> bytes:
        return bytes([number << 3 | 2, len(data)]) + data

    features = b""
    for name, value in (
        (b"name", inner(1, inner(1, b"a.png"))),
        (b"origin", inner(2, inner(1, struct.pack("<2f", 1.5, -2.0)))),
        (b"width", inner(3, inner(1, bytes([0xAC, 0x02])))),
    ):
        features += inner(1, inner(1, name) + inner(2, value))
    return inner(1, features)


def _read_record(file: Path) -> object:
    data = file.read_bytes()
    size = struct.pack("<Q", len(data))
    record = file.with_suffix(".record")
    record.write_bytes(
        size + struct.pack("<I", masked(crc32c(size))) + data + struct.pack("<I", masked(crc32c(data)))
    )
    example = next(read_examples(record))
    return example.blob("name"), example.numbers("origin", 2), example.integer("width")


def _meganerf(folder: Path) -> Target:
    metadata = folder / "train" / "metadata"
    images = folder / "train" / "rgbs"
    for place in (metadata, images):
        place.mkdir(parents=True)
    for k in range(2):
        _paint(images / f"{k}.png", k)
        pose = torch.tensor([[1, 0, 0, 0.3 * k], [0, 1, 0, 0], [0, 0, 1, 0]])
        torch.save(
            {"H": SIDE, "W": SIDE, "c2w": pose, "intrinsics": torch.tensor([30.0, 30, 12, 12])},
            metadata / f"{k}.pt",
        )
    parser = MegaNerfConfig().build()
    return Target("metadata of Mega-NeRF", metadata / "0.pt", lambda: parser.parse(folder, 1))


def _polycam(folder: Path) -> Target:
    names = _pictures(folder / "keyframes" / "images", 2)
    cameras = folder / "keyframes" / "cameras"
    cameras.mkdir()
    for k, name in enumerate(names):
        pose = {
            f"t_{row}{column}": float(row == column) + 0.3 * k * (column == 3)
            for row in range(3)
            for column in range(4)
        }
        lens = {"fx": 30.0, "fy": 30.0, "cx": SIDE / 2, "cy": SIDE / 2, "width": SIDE, "height": SIDE}
        (cameras / f"{Path(name).stem}.json").write_text(json.dumps(pose | lens))
    parser = PolycamConfig().build()
    return Target("camera of Polycam", cameras / "0.json", lambda: parser.parse(folder, 1))


def _record3d(folder: Path) -> Target:
    _pictures(folder / "rgb", 3)
    poses = [[0.0, 0.0, 0.0, 1.0, 0.3 * k, 0.0, 0.0] for k in range(3)]
    lenses = [[30.0, 30.0, SIDE / 2, SIDE / 2]] * 3
    document = {
        "w": SIDE,
        "h": SIDE,
        "K": [30, 0, 0, 0, 30, 0, 12, 12, 1],
        "poses": poses,
        "perFrameIntrinsicCoeffs": lenses,
    }
    file = folder / "metadata.json"
    file.write_text(json.dumps(document))
    parser = Record3DConfig().build()
    return Target("metadata of Record3D", file, lambda: parser.parse(folder, 1))


def _odm(folder: Path) -> list[Target]:
    """A project with a reconstruction, and one with a report alone."""
    camera = {
        "projection_type": "brown",
        "width": SIDE,
        "height": SIDE,
        "focal_x": 1.2,
        "focal_y": 1.2,
        "c_x": 0.01,
        "k1": 0.01,
    }
    shots = {}
    features = []
    for k, name in enumerate(_pictures(folder / "full" / "images", 3)):
        shots[name] = {"camera": "v2", "rotation": [0.0, 0.0, 0.1 * k], "translation": [0.3 * k, 0.0, 1.0]}
        features.append({"properties": {"filename": name, **shots[name]}})
    points = {str(k): {"coordinates": [0.1 * k, 0.0, 5.0], "color": [1, 2, 3]} for k in range(4)}
    whole = folder / "full" / "opensfm" / "reconstruction.json"
    part = folder / "report" / "odm_report" / "shots.geojson"
    _pictures(folder / "report" / "images", 3)
    for file, document in (
        (whole, [{"cameras": {"v2": camera}, "shots": shots, "points": points}]),
        (part, {"type": "FeatureCollection", "features": features}),
        (folder / "report" / "cameras.json", {"v2": camera}),
    ):
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(document))
    parser = OdmConfig().build()
    return [
        Target("reconstruction of ODM", whole, lambda: parser.parse(folder / "full", 1)),
        Target("shots of ODM", part, lambda: parser.parse(folder / "report", 1)),
        Target(
            "cameras of ODM", folder / "report" / "cameras.json", lambda: parser.parse(folder / "report", 1)
        ),
    ]


def _gaussians(folder: Path) -> list[Target]:
    """Every format, with view dependence where it has some; the folder's own meta.json last."""
    parts = (
        cases.normal(12, 3, seed=24),
        cases.normal(12, 4, seed=25),
        cases.normal(12, 3, seed=16),
        cases.normal(12, seed=26),
        0.1 * cases.normal(12, 4, 3, seed=27),
    )
    made = Gaussians(*parts)
    names = ["x.ply", "x.compressed.ply", "x.splat", "x.spz", "x.sog", "meta.json", "x.glb", "x.gltf"]
    for name in names:
        write_gaussians(folder / name, made)
    # What is read alone, and text, by hand.
    head, _, body = (folder / "x.ply").read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(12, -1)
    text = head.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    (folder / "ascii.ply").write_bytes(text + "\n".join(" ".join(map(str, row)) for row in rows).encode())
    section = struct.pack("<IIIIfHxxIIIIH", 12, 12, 12, 1, 5.0, 12, 0, 0, 1, 0, 0).ljust(1024, b"\0")
    start = struct.pack("<BBxxIIIIHxxfff", 0, 1, 1, 1, 12, 12, 1, 0, 0, 0).ljust(4096, b"\0")
    (folder / "x.ksplat").write_bytes(start + section + bytes(12) + bytes(range(24)) * 12)
    index = {"filenames": ["meta.json"], "tree": {"lods": {"0": {"file": 0, "offset": 2, "count": 9}}}}
    (folder / "lod-meta.json").write_text(json.dumps(index))
    names += ["ascii.ply", "x.ksplat", "lod-meta.json"]
    return [
        Target(f"Gaussians, {name}", folder / name, partial(read_capture, folder / name)) for name in names
    ]
