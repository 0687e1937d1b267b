"""Files of Gaussians however they are packed: headers, archives, axes, metadata, cameras."""

import gzip
import json
import os
import struct
import time
import zlib
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_ball import ball, equal, plain_ply
from test_more_formats import covariances, seen_along

from fprf.cli import main as cli
from fprf.errors import DataError
from fprf.io.tensorfiles import load_sealed
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.rendering.splines import rotations
from fprf.splats.captures import look_at_capture
from fprf.splats.config import LookConfig
from fprf.splats.drawing import draw
from fprf.splats.files import Capture, read_capture, write_capture, write_gaussians
from fprf.splats.files.sog_archive import bundle, unbundle
from fprf.splats.files.sog_images import lossless_webp, picture_of_rows
from fprf.splats.gaussians import Gaussians
from fprf.splats.pinholes import camera_of


def headed(data: bytes, change: Callable[[bytes], bytes]) -> bytes:
    head, end, rows = data.partition(b"end_header\n")
    return change(head + end) + rows


HEADS: dict[str, Callable[[bytes], bytes]] = {
    "CR LF": lambda head: head.replace(b"\n", b"\r\n"),
    "CR": lambda head: head.replace(b"\n", b"\r"),
    "blanks": lambda head: head.replace(b"\n", b" \t\n").replace(b"property float", b"property  float"),
    "latin-1": lambda head: head.replace(
        b"\nelement", b"\ncomment caf\xe9 \x85 \x0c odd \x1d end_header \xa0\nelement"
    ),
    "long": lambda head: head.replace(b"\nelement", b"\ncomment " + b"x" * 70_000 + b"\nelement"),
    "lines": lambda head: head.replace(b"\nelement", b"\nobj_info made\ncomment\n\ncomment y\nelement"),
}


@pytest.mark.parametrize("kind", HEADS)
@pytest.mark.parametrize("ending", [".ply", ".compressed.ply"])
def test_headers_of_any_making(kind: str, ending: str, tmp_path: Path) -> None:
    made = ball(40)
    path = tmp_path / f"x{ending}"
    made.means[0, 0] = float(np.frombuffer(b"\n\r\n?", "<f4")[0])  # data that begins like the end of a line
    write_gaussians(path, made)
    plain = read_capture(path)
    path.write_bytes(headed(plain.data, HEADS[kind]))
    capture = read_capture(path)
    assert all(map(torch.equal, vars(capture.gaussians).values(), vars(plain.gaussians).values()))
    write_capture(tmp_path / f"out{ending}", capture, capture.gaussians.harmonics * 0.5)
    write_capture(tmp_path / f"plain{ending}", plain, plain.gaussians.harmonics * 0.5)
    assert (tmp_path / f"out{ending}").read_bytes() == headed(
        (tmp_path / f"plain{ending}").read_bytes(), HEADS[kind]
    )


@pytest.mark.parametrize("lists", ["equal", "unequal", "cut"])
@pytest.mark.parametrize("first", [True, False])
def test_elements_with_lists_before_and_behind_the_gaussians(lists: str, first: bool, tmp_path: Path) -> None:
    made = ball(30)
    data = plain_ply(made)
    faces = [[0, 1, 2], [3, 4, 5]] if lists == "equal" else [[], [5], [1, 2, 3]]
    rows = b"".join(struct.pack(f"<B{len(each)}i", len(each), *each) for each in faces)
    element = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n".encode()
    rows = rows[:-3] if lists == "cut" else rows
    head, end, body = data.partition(b"end_header\n")
    if first:
        data = head.replace(b"element vertex", element + b"element vertex") + end + rows + body
    else:
        data = head + element + end + body + rows
    (tmp_path / "x.ply").write_bytes(data)
    if first and lists == "cut":
        with pytest.raises(DataError):
            read_capture(tmp_path / "x.ply")
        return
    capture = read_capture(tmp_path / "x.ply")
    assert torch.equal(capture.gaussians.means, made.means)
    write_capture(tmp_path / "y.ply", capture, capture.gaussians.harmonics * 0.5)
    changed = plain_ply(made.recoloured(made.harmonics * 0.5)).partition(b"end_header\n")[2]
    assert (tmp_path / "y.ply").read_bytes() == data.replace(body, changed)


def test_big_endian_and_integer_positions_are_read_and_recoloured_in_place(tmp_path: Path) -> None:
    made = ball(30)
    made.means.round_()
    head, end, body = plain_ply(made).partition(b"end_header\n")
    columns = np.frombuffer(body, "<f4").reshape(30, -1)
    kinds = [("x", ">i4"), ("y", ">f8"), *((f"p{k}", ">f4") for k in range(columns.shape[1] - 2))]
    rows = np.rec.fromarrays(columns.T, dtype=np.dtype(kinds))
    head = (
        head.replace(b"little", b"big").replace(b"float x\n", b"int x\n").replace(b"float y\n", b"double y\n")
    )
    (tmp_path / "x.ply").write_bytes(head + end + rows.tobytes())
    capture = read_capture(tmp_path / "x.ply")
    assert all(map(torch.equal, vars(capture.gaussians).values(), vars(made).values()))
    write_capture(tmp_path / "y.ply", capture, made.harmonics * 0.5)
    assert torch.equal(read_capture(tmp_path / "y.ply").gaussians.harmonics, made.harmonics * 0.5)


def ascii_ply(data: bytes, newline: str) -> bytes:
    """The file of `plain_ply` as text, with an element of lists and one of numbers before the Gaussians."""
    head, _, body = data.partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    rows = np.frombuffer(body, "<f4").reshape(count, -1)
    lines = head.decode().replace("binary_little_endian", "ascii").splitlines()
    extra = [
        "comment Vertical axis: z",
        "element face 2",
        "property list uchar int v",
        "element time 1",
        "property double t",
    ]
    extra += ["property char c", "property ushort u"]
    lines = [*lines[:2], *extra, *lines[2:], "end_header", "3 0 1 2", "0", "2.5 -1 9"]
    return newline.join([*lines, *(" ".join(repr(float(v)) for v in row) for row in rows), ""]).encode()


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_ascii_files_are_read_and_become_binary(newline: str, tmp_path: Path) -> None:
    made = ball(30, degree=2)
    path = tmp_path / "x.ply"
    path.write_bytes(ascii_ply(plain_ply(made), newline))
    capture = read_capture(path)
    assert equal(capture.gaussians, made) and capture.up == (0, 0, 1)
    write_capture(tmp_path / "y.ply", capture, made.harmonics * 0.5)
    again = read_capture(tmp_path / "y.ply")
    assert equal(again.gaussians, made.recoloured(made.harmonics * 0.5)) and again.up == (0, 0, 1)
    assert b"element time 1" in (tmp_path / "y.ply").read_bytes()
    text = path.read_bytes()
    one = b"".join(text.splitlines(keepends=True)[:-29]).replace(b"vertex 30", b"vertex 5")
    for wrong in (
        text[: len(text) // 2],
        one,
        text.replace(b"2.5", b"two"),
        text.replace(b"vertex 30", b"vertex 999999999"),
    ):
        path.write_bytes(wrong)
        with pytest.raises(DataError):
            read_capture(path)


@pytest.mark.parametrize(
    ("said", "up"),
    [
        ("Vertical axis: z", (0, 0, 1)),
        ("Exported from Brush\ncomment Vertical axis: z", (0, 0, -1)),
        ("Generated by Nerstudio 1.1.5\ncomment Vertical Axis: z", (0, 0, 1)),
        ("vertical AXIS: Y", (0, -1, 0)),
        ("Vertical axis: 0 0 1", (0, 0, 1)),
        ("Vertical axis: [0.6, -0.8, 0]", (0.6, -0.8, 0)),
        ("Vertical axis: +z", (0, 0, 1)),
        ("Vertical axis: 0 0 0", None),
        ("Vertical axis: nan 0 1", None),
        ("Vertical axis: up", None),
    ],
)
@pytest.mark.parametrize("ending", [".ply", ".compressed.ply"])
def test_comments_say_what_points_up(
    said: str, up: tuple[float, ...] | None, ending: str, tmp_path: Path
) -> None:
    path = tmp_path / f"x{ending}"
    write_gaussians(path, ball(300), antialiased=True)

    def commented(text: str) -> Capture:
        line = f"\ncomment {text}\nelement".encode()
        path.write_bytes(headed(path.read_bytes(), lambda head: head.replace(b"\nelement", line, 1)))
        return read_capture(path)

    capture = commented(said)
    assert capture.up == up and capture.antialiased
    assert not commented("SPLATRENDERMODE:  Default ").antialiased
    assert commented("Antialiased 1").antialiased, "the last one counts"


@pytest.mark.parametrize("legacy", [False, True])
def test_the_camera_in_a_file_is_the_first_view(legacy: bool, tmp_path: Path) -> None:
    made = ball(400)
    turn = rotations(torch.tensor([[0.9, 0.1, -0.3, 0.2]]).double())[0].numpy()  # world to camera
    place = np.array([[0.3], [-0.2], [4.0]])
    world = np.concatenate([turn.T if legacy else turn, place], 1).astype("<f4")
    if not legacy:
        world = np.concatenate([world, [[0, 0, 0, 1]]]).astype("<f4")
    lens = [500, 400, 640, 320] if legacy else [500, 0, 300, 0, 400, 170, 0, 0, 1]
    sizes = [] if legacy else [("image_size", "<u4", [640, 320], "uint")]
    head = b""
    rows = b""
    for name, kind, values, word in [
        ("extrinsic", "<f4", world, "float"),
        ("intrinsic", "<f4", lens, "float"),
        *sizes,
    ]:
        values = np.asarray(values, kind).ravel()
        head += f"element {name} {len(values)}\nproperty {word} {name}\n".encode()
        rows += values.tobytes()
    before, end, body = plain_ply(made).partition(b"end_header\n")
    (tmp_path / "x.ply").write_bytes(before + head + end + body + rows)
    capture = read_capture(tmp_path / "x.ply")
    camera = capture.camera
    assert camera is not None and capture.up is not None
    seen = camera_of(camera, 0)
    assert np.allclose(seen.world_to_camera[:3], np.concatenate([turn, place], 1), atol=1e-6)
    assert (seen.width, seen.height) == (640, 320) and float(seen.intrinsics[1, 1]) == 400
    assert np.allclose(capture.up, -turn[1], atol=1e-6), "the camera's up"
    scene = look_at_capture(
        made, False, BundledSemanticConfig().build(), LookConfig(views=5, size=(64, 48)), camera=camera
    )
    assert torch.equal(scene.views.size, torch.tensor([[64, 48]] * len(scene.views)))
    centre = -turn.T @ place[:, 0]
    apart = (scene.views.pose[:, :, 3].numpy() - centre) / 4
    assert np.allclose(apart[0], 0, atol=1e-6) and np.abs(apart).max() < 0.5, "the others stand about it"
    whole = draw(made, seen).image
    small = draw(made, camera_of(scene.views, 0)).image[8:40]
    mean = torch.nn.functional.interpolate(whole.permute(2, 0, 1)[None], (32, 64), mode="area")[0].permute(
        1, 2, 0
    )
    assert (small - mean).abs().mean() < 0.02


def test_an_unsound_camera_is_left_alone(tmp_path: Path) -> None:
    head, end, body = plain_ply(ball(20)).partition(b"end_header\n")
    element = b"element extrinsic 16\nproperty float e\nelement intrinsic 4\nproperty float i\n"
    for extrinsic, intrinsic in (
        (np.zeros(16), [9, 9, 9, 9]),
        (np.eye(4), [0, 9, 9, 9]),
        (np.eye(4), [9, np.nan, 9, 9]),
    ):
        rows = np.concatenate([extrinsic.ravel(), intrinsic]).astype("<f4").tobytes()
        (tmp_path / "x.ply").write_bytes(head + element + end + body + rows)
        assert read_capture(tmp_path / "x.ply").camera is None


def test_up_of_the_file_decides_the_views_and_a_flag_before_it(photograph: Path, tmp_path: Path) -> None:
    made = ball(300)
    data = headed(
        plain_ply(made), lambda head: head.replace(b"\nelement", b"\ncomment Vertical axis: 0 0 1\nelement")
    )
    (tmp_path / "in.ply").write_bytes(data)
    words = [
        "restyle",
        str(tmp_path / "in.ply"),
        "--references",
        str(photograph),
        "--views",
        "4",
        "--size",
        "64",
        "48",
    ]
    words += ["--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "out.ply")]
    for flag, up in (([], [0.0, 0.0, 1.0]), (["--up", "1", "0", "0"], [1.0, 0.0, 0.0])):
        assert cli.main([*words, *flag]) == 0
        kept = max((tmp_path / "cache").iterdir(), key=lambda each: each.stat().st_mtime_ns)
        pose = load_sealed(kept)["camera.pose"]
        assert (pose[:, :, 1] @ torch.tensor(up).double() > 0.3).all()
        assert (pose[:, :, 0] @ torch.tensor(up).double()).abs().max() < 1e-6, "upright"


def spz_parts(made: Gaussians, path: Path) -> bytes:
    write_gaussians(path, made)
    return gzip.decompress(path.read_bytes())


def test_a_spz_however_it_is_packed(tmp_path: Path) -> None:
    made = ball(300)
    path = tmp_path / "x.spz"
    content = spz_parts(made, path)
    plain = read_capture(path)
    zipped = gzip.compress(content, mtime=0)
    packings = {
        "raw": content,
        "members": b"".join(
            gzip.compress(part, mtime=0) for part in (content[:7], content[7:500], b"", content[500:])
        ),
        "trailing": zipped + bytes(100),
        "without checksum": zipped[:-8],
        "stored": gzip.compress(content, 0, mtime=0),
    }
    for name, data in packings.items():
        path.write_bytes(data)
        capture = read_capture(path)
        assert all(map(torch.equal, vars(capture.gaussians).values(), vars(plain.gaussians).values())), name
        write_capture(tmp_path / "same.spz", capture, capture.gaussians.harmonics)
        assert (tmp_path / "same.spz").read_bytes() == data
        write_capture(tmp_path / "y.spz", capture, capture.gaussians.harmonics * 0.5)
        again = read_capture(tmp_path / "y.spz")
        assert torch.equal(again.gaussians.means, plain.gaussians.means)
        assert (
            again.gaussians.harmonics - plain.gaussians.harmonics * 0.5
        ).abs().max() < 0.5 / 255 / 0.15 + 1e-6
        assert again.data.startswith(b"NGSP") == (name == "raw") and again.data.endswith(bytes(100)) == (
            name == "trailing"
        )
    for wrong in (
        zipped[:-8] + b"\1\2\3\4" + zipped[-4:],
        zipped[: len(zipped) // 2],
        gzip.compress(content[:4] + b"\5" + content[5:]),
        gzip.compress(content[:13] + b"\xff" + content[14:]),
        content[:-1],
    ):
        path.write_bytes(wrong)
        with pytest.raises(DataError):
            read_capture(path)


LETTERS = [
    "LDB",
    "RDB",
    "LUB",
    "RUB",
    "LDF",
    "RDF",
    "LUF",
    "RUF",
    "LBD",
    "RBD",
    "LBU",
    "RBU",
    "LFD",
    "RFD",
    "LFU",
    "RFU",
]


WAYS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}


@pytest.mark.parametrize("number", range(1, 17))
def test_a_spz_says_its_axes(number: int, tmp_path: Path) -> None:
    """Positions, shapes and colours of the same numbers, with each axis where its letter says."""
    path = tmp_path / "x.spz"
    content = bytearray(spz_parts(ball(60, degree=3), path))
    assert content[-12:] == struct.pack("<III", 0xADBE0003, 4, 6), "ours names those of a PLY"
    del content[-12:]
    plain = read_capture(path).gaussians
    content += struct.pack("<III", 0x12340001, 4, 7) + struct.pack("<III", 0xADBE0003, 4, number)
    path.write_bytes(gzip.compress(bytes(content)))
    capture = read_capture(path)
    found = capture.gaussians
    axes = (
        torch.tensor([WAYS[letter] for letter in LETTERS[number - 1]]).double().T
    )  # file to right down front
    change = axes @ torch.tensor([WAYS[letter] for letter in "RDF"]).double()
    assert torch.allclose(found.means.double(), plain.means.double() @ change.T)

    assert torch.allclose(covariances(found), change @ covariances(plain) @ change.T, atol=1e-6)
    directions = torch.nn.functional.normalize(torch.randn(50, 3).double(), dim=1)
    assert torch.allclose(seen_along(plain, directions), seen_along(found, directions @ change.T), atol=1e-5)
    new = found.harmonics * 0.5
    write_capture(tmp_path / "y.spz", capture, new)
    again = read_capture(tmp_path / "y.spz").gaussians
    assert torch.equal(again.means, found.means) and (again.harmonics - new).abs().max() < 0.02


def sog_of(made: Gaussians, path: Path) -> dict[str, bytes]:
    write_gaussians(path, made)
    return unbundle(path, path.read_bytes())


def test_a_sog_however_it_is_archived(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.sog"
    parts = sog_of(ball(300), path)
    plain = read_capture(path)
    inside = {f"scene/{name}": content for name, content in parts.items()}
    for files in (
        inside,
        inside | {f"__MACOSX/scene/._{name}": b"\0\5\x16\7" for name in parts},
        parts | {f"__MACOSX/._{name}": b"\0\5\x16\7" for name in parts} | {"readme.txt": b"hello"},
        inside | {"scene/deeper/meta.json": b"{}"},
    ):
        path.write_bytes(bundle(files))
        capture = read_capture(path)
        assert all(map(torch.equal, vars(capture.gaussians).values(), vars(plain.gaussians).values()))
        write_capture(tmp_path / "y.sog", capture, capture.gaussians.harmonics * 0.5)
        again = unbundle(tmp_path / "y.sog", (tmp_path / "y.sog").read_bytes())
        assert list(again) == list(files)
        kept = [
            name
            for name in files
            if not name.endswith(("meta.json", "sh0.webp", "shN_centroids.webp")) or "._" in name
        ]
        assert all(again[name] == files[name] for name in kept)
        write_capture(tmp_path / "folder" / "meta.json", capture, capture.gaussians.harmonics * 0.5)
        found = read_capture(tmp_path / "folder").gaussians
        assert torch.equal(found.means, plain.gaussians.means)
        assert {each.name for each in (tmp_path / "folder").iterdir()} == {*parts}, (
            "no other file is replaced"
        )
    # A folder that is cut off while its files take their names is none.
    calls = count(1)
    replaced = os.replace
    monkeypatch.setattr(
        os, "replace", lambda *names: replaced(*names) if next(calls) < 3 else os.stat("absent")
    )
    with pytest.raises(DataError):
        write_capture(tmp_path / "folder" / "meta.json", plain, plain.gaussians.harmonics * 0.5)
    with pytest.raises(DataError, match="cannot be read"):
        read_capture(tmp_path / "folder")
    monkeypatch.undo()
    meta = json.loads(parts["meta.json"]) | {"more": {"files": [".bashrc"]}}
    path.write_bytes(bundle(parts | {"meta.json": json.dumps(meta).encode(), ".bashrc": b"echo"}))
    with pytest.raises(DataError, match="bashrc"):
        write_capture(tmp_path / "folder" / "meta.json", read_capture(path), plain.gaussians.harmonics)


def test_short_codebooks_and_models_of_sog(tmp_path: Path) -> None:
    path = tmp_path / "x.sog"
    made = ball(200, degree=0)
    made.log_scales.copy_((made.log_scales * 4).round() / 4)
    parts = sog_of(made, path)
    plain = read_capture(path)
    meta = json.loads(parts["meta.json"])
    used = len(np.unique(plain.gaussians.log_scales))

    def read(**changes: object) -> Capture:
        path.write_bytes(bundle(parts | {"meta.json": json.dumps(meta | changes).encode()}))
        return read_capture(path)

    book = np.unique(plain.gaussians.log_scales.numpy())
    index = np.searchsorted(book, plain.gaussians.log_scales.numpy())
    parts["scales.webp"] = lossless_webp(picture_of_rows(index, (13, 16)))
    short = {"files": ["scales.webp"], "codebook": book.astype(float).tolist()}
    assert torch.equal(read(scales=short).gaussians.log_scales, plain.gaussians.log_scales) and used < 16
    with pytest.raises(DataError):
        read(scales=short | {"codebook": short["codebook"][:-1]})
    assert (
        read(scales=short, model="antialiased").antialiased
        and not read(scales=short, model="default").antialiased
    )
    flat = read(scales=short, model="2dgs").gaussians.log_scales
    assert bool((flat[:, 2] == -torch.inf).all()) and torch.equal(
        flat[:, :2], plain.gaussians.log_scales[:, :2]
    )
    for wrong in ({"version": 3}, {"count": 0}, {"count": 4000}):
        with pytest.raises(DataError):
            read(scales=short, **wrong)


def test_a_small_gzip_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    content = spz_parts(ball(40), tmp_path / "x.spz")
    packer = zlib.compressobj(9, wbits=31)
    (tmp_path / "x.spz").write_bytes(packer.compress(content + bytes(64 << 20)) + packer.flush())
    with pytest.raises(DataError):
        read_capture(tmp_path / "x.spz")


@pytest.mark.parametrize("ending", ["spz", "ply"])
def test_a_small_file_of_many_pieces_takes_no_minutes(ending: str, tmp_path: Path) -> None:
    """Empty members of gzip, and faces of a mesh."""
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nelement face 3000000\n"
    mesh = head + b"property list uchar int v\nend_header\n" + bytes(3_000_004)
    (tmp_path / f"x.{ending}").write_bytes(mesh if ending == "ply" else gzip.compress(b"") * 150_000)
    start = time.process_time()
    with pytest.raises(DataError):
        read_capture(tmp_path / f"x.{ending}")
    assert time.process_time() - start < 3


@pytest.mark.parametrize("ending", ["ply", "glb", "sog", "splat"])
def test_a_pointer_of_git_lfs_is_told(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"x.{ending}"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n")
    with pytest.raises(DataError, match="git lfs pull"):
        read_capture(path)
