"""Captures as people have them: rows that cannot be drawn, outliers, odd headers, archives and metadata."""

import gzip
import itertools
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_ball import ball, equal, plain_ply

from fprf.cli import main as cli
from fprf.errors import DataError
from fprf.ops.harmonics import spherical_harmonics as functions
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.rendering.local_frame import read_offset
from fprf.rendering.splines import rotations
from fprf.splats.captures import look_at_capture
from fprf.splats.config import LookConfig
from fprf.splats.files import Capture, Written, read_capture, write_capture, write_gaussians
from fprf.splats.files.sog import bundle, unbundle
from fprf.splats.gaussians import Gaussians
from fprf.splats.photographs import camera_of
from fprf.splats.views import draw, find_views

# How far positions in a unit ball and ln-scales from -6 to -1 may move.
STEPS = {
    ".ply": (0.0, 0.0),
    ".compressed.ply": (1.5e-3, 0.02),
    ".splat": (0.0, 1e-6),
    ".spz": (2**-12, 1 / 32),
    ".sog": (2e-4, 0.03),
}
BAD: dict[str, Callable[[Gaussians, int], None]] = {
    "NaN": lambda g, i: g.means[i].fill_(torch.nan),
    "infinite": lambda g, i: g.means[i, :1].fill_(-torch.inf),
    "endless": lambda g, i: g.log_scales[i, 1:2].fill_(torch.inf),
    "unrotated": lambda g, i: g.quaternions[i].fill_(0),
    "zeros": lambda g, i: [part[i].fill_(0) for part in vars(g).values()] and None,
    "black hole": lambda g, i: g.harmonics[i, 0, :1].fill_(torch.nan),
}


def capture_of(folder: Path, gaussians: Gaussians) -> Capture:
    (folder / "in.ply").write_bytes(plain_ply(gaussians))
    return read_capture(folder / "in.ply")


def converted(capture: Capture, path: Path) -> tuple[Gaussians, Written]:
    written = write_capture(path, capture, capture.gaussians.harmonics)
    return read_capture(path).gaussians, written


def errors(of: Gaussians, found: Gaussians) -> tuple[float, float]:
    """Largest errors of positions and ln-scales: each Gaussian against the nearest that was found."""
    apart = torch.cdist(of.means.double(), found.means.double(), p=torch.inf, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = apart.argmin(1)
    assert len(nearest.unique()) == len(of), "each is there"
    scales = (found.log_scales[nearest] - of.log_scales).abs().nan_to_num(0, 0)
    return float(apart.amin(1).max()), float(scales.max())


@pytest.mark.parametrize("ending", STEPS)
@pytest.mark.parametrize("fault", BAD)
def test_what_cannot_be_drawn_is_left_out_of_another_format(ending: str, fault: str, tmp_path: Path) -> None:
    made, whole = ball(400), ball(400)
    for i in (3, 4, 399):
        BAD[fault](made, i)
    capture = capture_of(tmp_path, made)
    sound = torch.ones(400, dtype=torch.bool).index_fill(0, torch.tensor([3, 4, 399]), False)
    assert torch.equal(capture.gaussians.finite, sound) and capture.gaussians.faults()[0].startswith("3 ")
    spz = tmp_path / "x.spz"
    write_gaussians(spz, made)
    # .ply from another format: a .splat can hold such rows.
    found, written = converted(capture, tmp_path / f"out{ending}") if ending != ".ply" else (read_capture(spz).gaussians, None)
    assert len(found) == 397 and bool(found.finite.all())
    position, scale = errors(whole.select(sound), found)
    assert position <= max(STEPS[ending][0], 1e-6) and scale <= max(STEPS[ending][1], 1 / 32)
    assert written is None or (written.faulty and not written.far)


def test_rows_that_cannot_be_drawn_stay_as_they_are_in_their_format(tmp_path: Path) -> None:
    made = ball(12 * len(BAD))
    for i, spoil in enumerate(BAD.values()):
        spoil(made, 7 * i)
    capture = capture_of(tmp_path, made)
    new = capture.gaussians.harmonics + 0.1
    write_capture(tmp_path / "out.ply", capture, new[capture.gaussians.finite])
    before, after = (np.frombuffer(each[each.index(b"end_header\n") + 11 :], "<f4").reshape(len(made), -1)
                     for each in (capture.data, (tmp_path / "out.ply").read_bytes()))  # fmt: skip
    same = (before.view("<u4") == after.view("<u4")).all(1)
    assert np.array_equal(same, ~capture.gaussians.finite.numpy())
    assert np.array_equal(before.view("<u4")[:, :6], after.view("<u4")[:, :6])


@pytest.mark.parametrize("ending", STEPS)
def test_flat_gaussians_are_drawn_and_spoil_no_sizes(ending: str, tmp_path: Path) -> None:
    made = ball(400)
    made.log_scales[::2, 2] = -torch.inf
    capture = capture_of(tmp_path, made)
    found, written = converted(capture, tmp_path / f"out{ending}")
    assert bool(capture.gaussians.finite.all()) and len(found) == 400 and written == Written()
    position, scale = errors(made, found)
    assert position <= STEPS[ending][0] + 1e-7 and scale <= STEPS[ending][1] + 1e-6
    nearest = torch.cdist(made.means.double(), found.means.double()).argmin(1)
    assert (found.log_scales[nearest[::2], 2] <= -9.9).all()
    drawable = capture.gaussians.drawable()
    views = find_views(drawable, count=3, size=(64, 48), up=torch.tensor([0.0, -1, 0]))
    thin = Gaussians(**(vars(made) | {"log_scales": made.log_scales.clamp_min(-14)}))
    shown, wanted = (draw(each, camera_of(views, 0)).image for each in (drawable, thin))
    assert wanted.amax() > 0.4 and (shown - wanted).abs().max() < 1e-3


def test_surroundings_and_object_keep_their_precision(tmp_path: Path) -> None:
    """Surroundings 30 times as far as the object stay where they are, and so does the object."""
    made = ball(3000)  # 2500 of the object: the last of their chunks has room for 60
    sky = torch.nn.functional.normalize(torch.randn(500, 3), dim=1) * 30
    made.means[:500] = sky
    found, written = converted(capture_of(tmp_path, made), tmp_path / "out.compressed.ply")
    assert written == Written() and len(found) == 3060
    assert int((found.opacities < 1e-5).sum()) == 60, "filled up with transparent ones"
    assert errors(made.select(slice(500, None)), found.select(found.means.norm(dim=1) < 2))[0] < 1.5e-3
    far = found.select(found.means.norm(dim=1) > 2)
    assert (torch.cdist(far.means, sky).amin(1) < 60 / 1023).all()
    for ending in (".spz", ".sog"):
        assert converted(capture_of(tmp_path, made), tmp_path / f"out{ending}")[1] == Written()


SPOILED = st.lists(st.tuples(st.integers(0, 299), st.sampled_from([*BAD, "far", "huge", "bright", "flat"])), max_size=20)


@settings(max_examples=25)
@given(SPOILED, st.floats(2, 14), st.sampled_from(list(itertools.permutations(STEPS, 2))))
def test_the_others_survive_any_mixture_of_bad_rows_between_any_two_formats(
    tmp_path: Path, spoiled: list[tuple[int, str]], power: float, endings: tuple[str, str]
) -> None:
    made, whole, sound = ball(300, seed=1), ball(300, seed=1), torch.ones(300, dtype=torch.bool)
    for i, fault in spoiled:
        sound[i] = False
        if fault == "far":
            made.means[i, i % 3] = (-1) ** i * 10**power
        elif fault == "huge":
            made.log_scales[i] = 60.0
        elif fault == "bright":
            made.harmonics[i] = 10**power
        elif fault == "flat":
            made.log_scales[i, i % 3] = -torch.inf
        else:
            BAD[fault](made, i)
    capture = capture_of(tmp_path, made)
    for ending in endings:
        path = tmp_path / f"between{ending}"
        write_capture(path, capture, capture.gaussians.harmonics)
        capture = read_capture(path)
    found = capture.gaussians.select((capture.gaussians.means.abs() < 3).all(1) & capture.gaussians.finite)
    position, scale = errors(whole.select(sound), found)
    assert position <= sum(STEPS[each][0] for each in endings) + 1e-6
    assert scale <= sum(STEPS[each][1] for each in endings) + 1e-5
    nearest = torch.cdist(whole.means[sound].double(), found.means.double()).argmin(1)
    assert (found.colours[nearest].clamp(0, 1) - whole.colours[sound].clamp(0, 1)).abs().max() < 0.03


def test_captures_far_from_the_origin_keep_their_shape_or_are_refused(tmp_path: Path) -> None:
    made, far = ball(200), ball(200)
    far.means[:, 1] += 2e5
    step = float(np.spacing(np.float32(2e5)))
    found, written = converted(capture_of(tmp_path, far), tmp_path / "out.spz")
    offset = torch.tensor(read_offset(tmp_path / "out.spz"))
    assert errors(Gaussians(far.means - offset, *list(vars(far).values())[1:]), found)[0] <= 1e-4 and not written.notes
    assert ((found.means + offset).amax(0) - far.means.amax(0)).abs().max() <= step
    made.means[:, 1] += 1e7
    with pytest.raises(DataError):
        capture_of(tmp_path, made)


def test_sizes_beyond_those_of_spz_are_said(tmp_path: Path) -> None:
    small = ball(200)
    small = Gaussians(small.means * 1e-3, small.quaternions, small.log_scales - 9, small.logits, small.harmonics)
    assert converted(capture_of(tmp_path, small), tmp_path / "out.spz")[1].notes[0].startswith("200 ")


def headed(data: bytes, change: Callable[[bytes], bytes]) -> bytes:
    head, end, rows = data.partition(b"end_header\n")
    return change(head + end) + rows


HEADS: dict[str, Callable[[bytes], bytes]] = {
    "CR LF": lambda head: head.replace(b"\n", b"\r\n"),
    "CR": lambda head: head.replace(b"\n", b"\r"),
    "blanks": lambda head: head.replace(b"\n", b" \t\n").replace(b"property float", b"property  float"),
    "latin-1": lambda head: head.replace(b"\nelement", b"\ncomment caf\xe9 \x85 \x0c odd \x1d end_header \xa0\nelement"),
    "long": lambda head: head.replace(b"\nelement", b"\ncomment " + b"x" * 70_000 + b"\nelement"),
    "lines": lambda head: head.replace(b"\nelement", b"\nobj_info made\ncomment\n\ncomment y\nelement"),
}


@pytest.mark.parametrize("kind", HEADS)
@pytest.mark.parametrize("ending", [".ply", ".compressed.ply"])
def test_headers_of_any_making(kind: str, ending: str, tmp_path: Path) -> None:
    made, path = ball(40), tmp_path / f"x{ending}"
    made.means[0, 0] = float(np.frombuffer(b"\n\r\n?", "<f4")[0])  # data that begins like the end of a line
    write_gaussians(path, made)
    plain = read_capture(path)
    path.write_bytes(headed(plain.data, HEADS[kind]))
    capture = read_capture(path)
    assert all(map(torch.equal, vars(capture.gaussians).values(), vars(plain.gaussians).values()))
    write_capture(tmp_path / f"out{ending}", capture, capture.gaussians.harmonics * 0.5)
    write_capture(tmp_path / f"plain{ending}", plain, plain.gaussians.harmonics * 0.5)
    assert (tmp_path / f"out{ending}").read_bytes() == headed((tmp_path / f"plain{ending}").read_bytes(), HEADS[kind])


@pytest.mark.parametrize("lists", ["equal", "unequal", "cut"])
def test_elements_with_lists_behind_the_gaussians_stay_as_they_are(lists: str, tmp_path: Path) -> None:
    made = ball(30)
    data = plain_ply(made)
    faces = [[0, 1, 2], [3, 4, 5]] if lists == "equal" else [[], [5], [1, 2, 3]]
    rows = b"".join(struct.pack(f"<B{len(each)}i", len(each), *each) for each in faces)
    element = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n".encode()
    rows = rows[:-3] if lists == "cut" else rows
    head, end, body = data.partition(b"end_header\n")
    data = head + element + end + body + rows
    (tmp_path / "x.ply").write_bytes(data)
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
    head = head.replace(b"little", b"big").replace(b"float x\n", b"int x\n").replace(b"float y\n", b"double y\n")
    (tmp_path / "x.ply").write_bytes(head + end + rows.tobytes())
    capture = read_capture(tmp_path / "x.ply")
    assert all(map(torch.equal, vars(capture.gaussians).values(), vars(made).values()))
    write_capture(tmp_path / "y.ply", capture, made.harmonics * 0.5)
    assert torch.equal(read_capture(tmp_path / "y.ply").gaussians.harmonics, made.harmonics * 0.5)


def ascii_ply(data: bytes, newline: str) -> bytes:
    """The file of `plain_ply` as text, with an element of numbers before the Gaussians and one of lists behind them."""
    head, _, body = data.partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    rows = np.frombuffer(body, "<f4").reshape(count, -1)
    lines = head.decode().replace("binary_little_endian", "ascii").splitlines()
    extra = ["comment Vertical axis: z", "element time 1", "property double t"]
    lists = ["element face 2", "property list uchar int v"]
    lines = [*lines[:2], *extra, *lines[2:], *lists, "end_header", "2.5"]
    return newline.join([*lines, *(" ".join(repr(float(v)) for v in row) for row in rows), "3 0 1 2", "0", ""]).encode()


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_ascii_files_are_read_and_become_binary(newline: str, tmp_path: Path) -> None:
    made, path = ball(30, degree=2), tmp_path / "x.ply"
    path.write_bytes(ascii_ply(plain_ply(made), newline))
    capture = read_capture(path)
    assert equal(capture.gaussians, made) and capture.up == (0, 0, -1)
    write_capture(tmp_path / "y.ply", capture, made.harmonics * 0.5)
    again = read_capture(tmp_path / "y.ply")
    assert equal(again.gaussians, made.recoloured(made.harmonics * 0.5)) and again.up == (0, 0, -1)
    assert b"element time 1" in (tmp_path / "y.ply").read_bytes()
    text = path.read_bytes()
    for wrong in (text[: len(text) // 2], text.replace(b"2.5", b"two"), text.replace(b"vertex 30", b"vertex 999999999")):
        path.write_bytes(wrong)
        with pytest.raises(DataError):
            read_capture(path)


def test_colours_of_bytes_and_flat_gaussians_are_read_and_recoloured_in_place(tmp_path: Path) -> None:
    made = ball(30, degree=0)
    made.harmonics[:, 0] = torch.linspace(-1, 1, 90).view(30, 3)
    columns = np.frombuffer(plain_ply(made).partition(b"end_header\n")[2], "<f4").reshape(30, 17)
    names = [*"xyz", "nx", "ny", "nz", "red", "green", "blue", "opacity", "scale_0", "scale_1", *(f"rot_{i}" for i in range(4))]
    kinds = [(name, "u1" if name in ("red", "green", "blue") else "<f4") for name in names]
    columns = np.delete(columns, 12, 1)
    columns[:, 6:9] = np.rint(255 * made.colours.numpy())
    rows = np.rec.fromarrays(columns.T, dtype=np.dtype(kinds))
    lines = ["ply", "format binary_little_endian 1.0", "comment SplatRenderMode: 2dgs", "element vertex 30"]
    lines += [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in kinds]
    data = "\n".join([*lines, "end_header", ""]).encode() + rows.tobytes()
    (tmp_path / "x.ply").write_bytes(data)
    capture = read_capture(tmp_path / "x.ply")
    assert (capture.gaussians.colours - made.colours).abs().max() <= 0.5 / 255 + 1e-6
    assert torch.equal(capture.gaussians.log_scales[:, :2], made.log_scales[:, :2])
    assert bool((capture.gaussians.log_scales[:, 2] == -torch.inf).all()) and bool(capture.gaussians.finite.all())
    write_capture(tmp_path / "y.ply", capture, capture.gaussians.harmonics * 0.5)
    new = (tmp_path / "y.ply").read_bytes()
    apart = np.frombuffer(new, np.uint8).astype(int) - np.frombuffer(data, np.uint8)
    assert len(new) == len(data) and 60 < np.count_nonzero(apart) <= 90, "bytes of colours alone"
    again = read_capture(tmp_path / "y.ply").gaussians
    assert (again.harmonics - capture.gaussians.harmonics * 0.5).abs().max() <= 0.5 / 255 / 0.28


@pytest.mark.parametrize(
    ("said", "up"),
    [
        ("Vertical axis: z", (0, 0, -1)),
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
def test_comments_say_what_points_up(said: str, up: tuple[float, ...] | None, ending: str, tmp_path: Path) -> None:
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
    head, rows = b"", b""
    for name, kind, values, word in [("extrinsic", "<f4", world, "float"), ("intrinsic", "<f4", lens, "float"), *sizes]:
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
    scene = look_at_capture(made, False, BundledSemanticConfig().build(), LookConfig(views=5, size=(64, 48)), camera=camera)
    assert torch.equal(scene.views.size, torch.tensor([[64, 48]] * len(scene.views)))
    centre = -turn.T @ place[:, 0]
    apart = (scene.views.pose[:, :, 3].numpy() - centre) / 4
    assert np.allclose(apart[0], 0, atol=1e-6) and np.abs(apart).max() < 0.5, "the others stand about it"
    whole = draw(made, seen).image
    small = draw(made, camera_of(scene.views, 0)).image[8:40]
    mean = torch.nn.functional.interpolate(whole.permute(2, 0, 1)[None], (32, 64), mode="area")[0].permute(1, 2, 0)
    assert (small - mean).abs().mean() < 0.02


def test_an_unsound_camera_is_left_alone(tmp_path: Path) -> None:
    head, end, body = plain_ply(ball(20)).partition(b"end_header\n")
    element = b"element extrinsic 16\nproperty float e\nelement intrinsic 4\nproperty float i\n"
    for extrinsic, intrinsic in ((np.zeros(16), [9, 9, 9, 9]), (np.eye(4), [0, 9, 9, 9]), (np.eye(4), [9, np.nan, 9, 9])):
        rows = np.concatenate([extrinsic.ravel(), intrinsic]).astype("<f4").tobytes()
        (tmp_path / "x.ply").write_bytes(head + element + end + body + rows)
        assert read_capture(tmp_path / "x.ply").camera is None


def test_up_of_the_file_decides_the_views_and_a_flag_before_it(tmp_path: Path) -> None:
    made = ball(300)
    data = headed(plain_ply(made), lambda head: head.replace(b"\nelement", b"\ncomment Vertical axis: 0 0 1\nelement"))
    (tmp_path / "in.ply").write_bytes(data)
    style = tmp_path / "style.png"
    import cv2

    cv2.imwrite(str(style), np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    words = ["restyle", str(tmp_path / "in.ply"), "--references", str(style), "--views", "4", "--size", "64", "48"]
    words += ["--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "out.ply")]
    from fprf.io.tensorfiles import load_sealed

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
    made, path = ball(300), tmp_path / "x.spz"
    content = spz_parts(made, path)
    plain, zipped = read_capture(path), gzip.compress(content, mtime=0)
    packings = {
        "raw": content,
        "members": b"".join(gzip.compress(part, mtime=0) for part in (content[:7], content[7:500], b"", content[500:])),
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
        assert (again.gaussians.harmonics - plain.gaussians.harmonics * 0.5).abs().max() < 0.5 / 255 / 0.15 + 1e-6
        assert again.data.startswith(b"NGSP") == (name == "raw") and again.data.endswith(bytes(100)) == (name == "trailing")
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


LETTERS = ["LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU", "RFU"]
WAYS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}


@pytest.mark.parametrize("number", range(1, 17))
def test_a_spz_says_its_axes(number: int, tmp_path: Path) -> None:
    """Positions, shapes and colours of the same numbers, with each axis where its letter says."""
    path = tmp_path / "x.spz"
    content = bytearray(spz_parts(ball(60, degree=3), path))
    plain = read_capture(path).gaussians
    content[14] |= 2
    content += struct.pack("<III", 0x12340001, 4, 7) + struct.pack("<III", 0xADBE0003, 4, number)
    path.write_bytes(gzip.compress(bytes(content)))
    capture = read_capture(path)
    found = capture.gaussians
    axes = torch.tensor([WAYS[letter] for letter in LETTERS[number - 1]]).double().T  # file to right down front
    change = axes @ torch.tensor([WAYS[letter] for letter in "RUB"]).double()
    assert torch.allclose(found.means.double(), plain.means.double() @ change.T)

    def covariance(of: Gaussians) -> torch.Tensor:
        half = rotations(of.quaternions.double()) * of.log_scales.double().exp()[:, None]
        return half @ half.mT

    assert torch.allclose(covariance(found), change @ covariance(plain) @ change.T, atol=1e-6)
    directions = torch.nn.functional.normalize(torch.randn(50, 3).double(), dim=1)
    before = torch.einsum("dk,nkc->dnc", functions(directions, 4), plain.harmonics.double())
    after = torch.einsum("dk,nkc->dnc", functions(directions @ change.T, 4), found.harmonics.double())
    assert torch.allclose(before, after, atol=1e-5)
    new = found.harmonics * 0.5
    write_capture(tmp_path / "y.spz", capture, new)
    again = read_capture(tmp_path / "y.spz").gaussians
    assert torch.equal(again.means, found.means) and (again.harmonics - new).abs().max() < 0.02


def sog_of(made: Gaussians, path: Path) -> dict[str, bytes]:
    write_gaussians(path, made)
    return unbundle(path, path.read_bytes())


def test_a_sog_however_it_is_archived(tmp_path: Path) -> None:
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
        kept = [name for name in files if not name.endswith(("meta.json", "sh0.webp", "shN_centroids.webp")) or "._" in name]
        assert all(again[name] == files[name] for name in kept)
        write_capture(tmp_path / "folder" / "meta.json", capture, capture.gaussians.harmonics * 0.5)
        found = read_capture(tmp_path / "folder").gaussians
        assert torch.equal(found.means, plain.gaussians.means)


def test_short_codebooks_and_models_of_sog(tmp_path: Path) -> None:
    path, made = tmp_path / "x.sog", ball(200, degree=0)
    made.log_scales.copy_((made.log_scales * 4).round() / 4)
    parts = sog_of(made, path)
    plain, meta = read_capture(path), json.loads(parts["meta.json"])
    used = len(np.unique(plain.gaussians.log_scales))

    def read(**changes: object) -> Capture:
        path.write_bytes(bundle(parts | {"meta.json": json.dumps(meta | changes).encode()}))
        return read_capture(path)

    from fprf.splats.files.sog import _picture, _webp

    book = np.unique(plain.gaussians.log_scales.numpy())
    index = np.searchsorted(book, plain.gaussians.log_scales.numpy())
    parts["scales.webp"] = _webp(_picture(index, (13, 16)))
    short = {"files": ["scales.webp"], "codebook": book.astype(float).tolist()}
    assert torch.equal(read(scales=short).gaussians.log_scales, plain.gaussians.log_scales) and used < 16
    with pytest.raises(DataError):
        read(scales=short | {"codebook": short["codebook"][:-1]})
    assert read(scales=short, model="antialiased").antialiased and not read(scales=short, model="default").antialiased
    flat = read(scales=short, model="2dgs").gaussians.log_scales
    assert bool((flat[:, 2] == -torch.inf).all()) and torch.equal(flat[:, :2], plain.gaussians.log_scales[:, :2])
    for wrong in ({"version": 3}, {"count": 0}, {"count": 4000}):
        with pytest.raises(DataError):
            read(scales=short, **wrong)


def few(name: str) -> Gaussians:
    made = ball(1 if name == "one" else 2 if name == "two" else 150)
    if name == "together":
        made.means[:] = 0.5
    elif name == "plane":
        made.means[:, 2] = 0.0
    elif name == "needles":
        made.log_scales[:, 1:] = -torch.inf
    elif name == "line":
        made.means[:, 1:] = 0.0
    return made


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["one", "two", "together", "plane", "line", "needles"])
def test_few_gaussians_and_those_in_a_plane_are_looked_at(name: str, tmp_path: Path) -> None:
    made = few(name)
    drawable = made.drawable()
    scene = look_at_capture(drawable, False, BundledSemanticConfig().build(), LookConfig(views=4, size=(64, 48), regions=3))
    assert bool(scene.views.pose.isfinite().all()) and bool(scene.found().features.isfinite().all())
    opacity = torch.stack([draw(drawable, camera_of(scene.views, v)).opacity.mean() for v in range(len(scene.views))])
    assert opacity.max() > (0.002 if name == "needles" else 0.02)
    for ending in STEPS:
        found, written = converted(capture_of(tmp_path, made), tmp_path / f"out{ending}")
        assert len(found) == len(made) and written == Written()
        apart = torch.cdist(made.means.double(), found.means.double(), p=torch.inf)
        assert apart.amin(1).max() <= STEPS[ending][0] + 1e-6


def test_a_capture_in_which_nothing_can_be_drawn_is_refused(tmp_path: Path) -> None:
    made = ball(5)
    made.quaternions[:] = 0
    with pytest.raises(DataError):
        capture_of(tmp_path, made)
    with pytest.raises(DataError):
        capture_of(tmp_path, ball(5).select(slice(0)))


def test_stray_gaussians_decide_neither_views_nor_semantics() -> None:
    made, look = ball(400), LookConfig(views=4, size=(64, 48), regions=3)
    stray = ball(400)
    stray.means[7] = torch.tensor([3e4, -2e5, 1e5])
    first, second = (look_at_capture(each, False, BundledSemanticConfig().build(), look) for each in (made, stray))
    away = [each.views.pose[:, :, 3].norm(dim=1) for each in (first, second)]
    assert torch.allclose(away[0].mean(), away[1].mean(), rtol=0.05)
    features = [each.found().style.share for each in (first, second)]
    assert torch.allclose(features[0], features[1], atol=0.1)


def test_a_small_gzip_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    content = spz_parts(ball(40), tmp_path / "x.spz")
    packer = zlib.compressobj(9, wbits=31)
    (tmp_path / "x.spz").write_bytes(packer.compress(content + bytes(64 << 20)) + packer.flush())
    with pytest.raises(DataError):
        read_capture(tmp_path / "x.spz")


@pytest.mark.parametrize("ending", ["ply", "glb", "sog", "splat"])
def test_a_pointer_of_git_lfs_is_told(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"x.{ending}"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n")
    with pytest.raises(DataError, match="git lfs pull"):
        read_capture(path)
