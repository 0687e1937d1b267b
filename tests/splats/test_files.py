"""Files of Gaussians: byte for byte back where nothing changed, within each format's steps where it is
written anew.
"""

import gzip
import json
import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fprf.errors import DataError
from fprf.plugins.captures import endings
from fprf.rendering.cameras import Cameras
from fprf.rendering.paths import look_at, pinhole
from fprf.splats.drawing import draw
from fprf.splats.files import Capture, read_capture, write_capture, write_gaussians
from fprf.splats.files.base import format_of, spatial_order
from fprf.splats.files.sog_archive import bundle, unbundle
from fprf.splats.gaussians import Gaussians
from fprf.splats.pinholes import camera_of

FORMATS = {ending: format_of(Path(f"x{ending}")) for ending in endings()}
WRITTEN = [ending for ending, form in FORMATS.items() if form.writes and form.reads]
SHAPE = ("means", "quaternions", "log_scales", "logits")
COUNT = 600
# most that positions in [-2, 2], ln-scales, opacities, mean colours and harmonics change by: half a step
STEP = {
    ".ply": (0.0, 0.0, 1e-7, 0.0, 0.0),
    ".compressed.ply": (2 / 1023, 2 / 1023, 0.5 / 255, 0.65 / 255, 4 / 256),
    ".splat": (0.0, 4e-7, 0.5 / 255, 0.5 / 255, 0.0),
    ".spz": (2**-20, 0.5 / 16, 0.5 / 255, 0.5 / 255 * 0.282 / 0.15, 0.5 / 128),
    ".sog": (1.6e-4, 0.5 / 16, 0.5 / 255, 0.02, 0.01),
    ".glb": (0.0, 1e-6, 1e-7, 0.0, 0.0),
    ".gltf": (0.0, 1e-6, 1e-7, 0.0, 0.0),
}


def cloud(degree: int, count: int = COUNT, seed: int = 0) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=draw)

    harmonics = 0.2 * (random(count, (degree + 1) ** 2, 3) - 0.5)
    harmonics[:, 0] *= 15
    turns = torch.nn.functional.normalize(random(count, 4) - 0.5, dim=1)
    return Gaussians(
        4 * random(count, 3) - 2, turns, -6 + 4 * random(count, 3), 8 * random(count) - 4, harmonics
    )


def written(
    path: Path, gaussians: Gaussians, *, antialiased: bool = False, views: Cameras | None = None
) -> Capture:
    """A file of Gaussians, as it is read."""
    write_gaussians(path, gaussians, antialiased=antialiased, views=views)
    return read_capture(path)


def restyled(path: Path, capture: Capture, harmonics: torch.Tensor) -> Capture:
    """A capture with new harmonics, as it is read from another file."""
    write_capture(path, capture, harmonics)
    return read_capture(path)


def from_the_front(side: int, fov: float) -> Cameras:
    """A view of the origin along -z."""
    pose = look_at(torch.tensor([[0.0, 0, 2]]), torch.zeros(1, 3), torch.tensor([0.0, 1, 0]))
    return pinhole(pose, width=side, height=side, fov=fov)


@pytest.fixture(
    params=[(e, d) for e in (*WRITTEN, "meta.json") for d in (0, 2) if e != ".splat" or d == 0],
    ids=lambda p: f"{p[0]}-{p[1]}",
)
def capture(request: pytest.FixtureRequest, tmp_path: Path) -> Capture:
    ending, degree = request.param
    name = ending if ending == "meta.json" else f"x{ending}"
    return written(tmp_path / name, cloud(degree), antialiased=ending != ".splat")


def test_new_colours_change_nothing_else_and_unchanged_ones_nothing(capture: Capture, tmp_path: Path) -> None:
    there = tmp_path / "there" / capture.path.name
    before = capture.gaussians
    write_capture(there, capture, before.harmonics.clone())
    for path in [capture.path] if there.name != "meta.json" else capture.path.parent.glob("*.*"):
        assert (there.parent / path.name).read_bytes() == path.read_bytes()
    assert capture.antialiased == (there.suffix != ".splat")
    new = before.harmonics.clone()
    new[::2] = 0.7 * new[::2] + 0.1
    after = restyled(there, capture, new).gaussians
    assert all(torch.equal(getattr(after, name), getattr(before, name)) for name in SHAPE)
    tolerance = 0.03 if capture.path.suffix != ".ply" or ".compressed" in capture.path.name else 0.0
    assert (after.harmonics - new).abs().max() <= tolerance
    assert (after.harmonics - new).square().mean().sqrt() <= 0.1 * (
        before.harmonics - new
    ).square().mean().sqrt()


@pytest.mark.parametrize("ending", STEP)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_written_gaussians_come_back_within_a_step(ending: str, degree: int, tmp_path: Path) -> None:
    made = cloud(degree)
    found = written(tmp_path / f"x{ending}", made).gaussians
    if ending in (".compressed.ply", ".sog"):
        made = made.select(torch.from_numpy(spatial_order(made.means.numpy())))
    assert found.degree == (0 if ending == ".splat" else degree)
    slack = 1e-6
    for name, most in zip(("means", "log_scales", "opacities", "colours"), STEP[ending], strict=False):
        assert (getattr(found, name) - getattr(made, name)).abs().max() <= most + slack
    rest = found.harmonics[:, 1:] - made.harmonics[:, 1 : found.harmonics.shape[1]]
    assert (rest.abs() <= STEP[ending][-1] + slack).all()
    turned = (torch.nn.functional.normalize(found.quaternions, dim=1) * made.quaternions).sum(1).abs()
    # Half a step of 8 bits in each of four components, at most.
    assert turned.min() >= 1 - 0.5 * 4 * (0.5 / 127) ** 2 - slack


def test_captures_change_their_format_with_the_ending(tmp_path: Path) -> None:
    capture = written(tmp_path / "x.ply", cloud(1), antialiased=True)
    wanted = 0.25 + 0.5 * float(capture.gaussians.colours.mean())
    for ending in (".spz", ".compressed.ply", ".sog", ".ply"):
        found = restyled(tmp_path / f"y{ending}", capture, capture.gaussians.harmonics * 0.5)
        assert found.antialiased and float(found.gaussians.colours.mean()) == pytest.approx(wanted, abs=0.01)
    packed = read_capture(tmp_path / "y.compressed.ply")
    (tmp_path / "z.ply").write_bytes(packed.data)
    again = restyled(tmp_path / "w.ply", read_capture(tmp_path / "z.ply"), packed.gaussians.harmonics)
    assert again.data == packed.data, "a compressed file under the plain ending stays one"
    unpacked = restyled(tmp_path / "v.ply", packed, packed.gaussians.harmonics)
    assert unpacked.data != packed.data and torch.equal(unpacked.gaussians.means, packed.gaussians.means)


def test_without_view_dependence_a_file_holds_the_colours_that_views_show(tmp_path: Path) -> None:
    """One Gaussian seen from the front alone, and one that no view shows and that is looked at from there as
    well.
    """
    harmonics = torch.zeros(2, 4, 3)
    harmonics[:, 2] = torch.tensor([0.6, -0.3, 0.0])  # Y = 0.4886 z
    means = torch.tensor([[0.0, 0.0, 0.0], [0.0, 50.0, 0.0]])
    there = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), -2.0), torch.full((2,), 3.0), harmonics
    )
    seen = written(tmp_path / "seen.splat", there, views=from_the_front(32, 40)).gaussians.colours
    direction = torch.nn.functional.normalize(means - torch.tensor([0.0, 0, 2]), dim=1)
    wanted = 0.5 + 0.48860251 * direction[:, 2:] * harmonics[:, 2]
    assert torch.allclose(seen, wanted, atol=0.5 / 255 + 1e-6)
    every = written(tmp_path / "all.splat", there).gaussians.colours
    assert torch.allclose(every, torch.full((2, 3), 0.5), atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize("ending", [".ply", ".splat"])
def test_plain_opacities_show_thin_gaussians_as_compensation_does(tmp_path: Path, ending: str) -> None:
    """Needles that one view shows apart from each other: without compensation they would be up to five times
    as heavy.
    """
    means = torch.tensor([[0.4 * x, 0.4 * y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    scales = torch.log(torch.tensor([0.1, 1e-3, 1e-3])) + torch.linspace(0, 2, 9)[:, None]
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 9)
    there = Gaussians(means, turns, scales, torch.full((9,), 2.0), torch.full((9, 1, 3), 1.0))
    views = from_the_front(64, 45)
    write_gaussians(tmp_path / f"x{ending}", there, antialiased=True, views=views, plain=ending == ".ply")
    plain = read_capture(tmp_path / f"x{ending}")
    assert not plain.antialiased
    camera = camera_of(views, 0)
    wanted, shown, heavy = (
        draw(g, camera, antialiased=aa).opacity
        for g, aa in ((there, True), (plain.gaussians, False), (there, False))
    )
    assert (shown - wanted).abs().max() < (1e-4 if ending == ".ply" else 0.03)
    assert (heavy - wanted).abs().max() > 0.4
    exact = written(tmp_path / "exact.ply", there, antialiased=True, views=views)
    assert exact.antialiased and torch.equal(exact.gaussians.logits, there.logits)


def test_a_ply_keeps_header_order_and_what_it_does_not_know(tmp_path: Path) -> None:
    kinds = [
        ("f_dc_2", "double"),
        ("label", "int"),
        *((f"rot_{i}", "float") for i in range(4)),
        ("z", "float"),
        ("y", "float"),
    ]
    kinds += [
        ("x", "float"),
        ("opacity", "float"),
        ("f_dc_0", "float"),
        ("f_dc_1", "float"),
        ("confidence", "uchar"),
    ]
    kinds += [(f"scale_{i}", "float") for i in range(3)]
    codes = {"double": "<f8", "int": "<i4", "float": "<f4", "uchar": "u1"}
    table = np.zeros(5, [(name, codes[kind]) for name, kind in kinds])
    for k, (name, _) in enumerate(kinds):
        table[name] = np.arange(5) + 0.1 * k + 1
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment by hand",
        "element sensor 1",
        "property double t",
    ]
    lines += ["element vertex 5", *(f"property {kind} {name}" for name, kind in kinds)]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    data = (
        "\r\n".join(lines).encode()
        + struct.pack("<d", 3.5)
        + table.tobytes()
        + b"\3"
        + struct.pack("<3i", 0, 1, 2)
    )
    path = tmp_path / "x.ply"
    path.write_bytes(data)
    capture = read_capture(path)
    assert torch.equal(capture.gaussians.means[:, 0], torch.from_numpy(table["x"].copy()))
    new = capture.gaussians.harmonics.clone()
    new[3] = 0.25
    expected = table.copy()
    for name in ("f_dc_0", "f_dc_1", "f_dc_2"):
        expected[name][3] = 0.25
    assert restyled(tmp_path / "y.ply", capture, new).data == data.replace(
        table.tobytes(), expected.tobytes()
    )


def older_spz(version: int) -> bytes:
    """Two Gaussians, by hand, without a word of their axes."""
    at = np.array([[1.0, 2.0, -3.0], [0.5, 0.0, 0.25]])
    if version == 1:
        positions = at.astype("<f2").tobytes()
    else:
        whole = np.rint(at * 4096).astype(np.int64) & 0xFFFFFF
        positions = np.stack([whole & 255, whole >> 8 & 255, whole >> 16], -1).astype(np.uint8).tobytes()
    streams = [positions, bytes([255, 51]), bytes([128, 0, 255] * 2), bytes([160, 144, 128] * 2)]
    streams += [bytes([255, 128, 128, 128, 255, 128]) if version < 3 else struct.pack("<2I", 3 << 30, 0)]
    streams += [bytes(range(120, 129)) * 2]
    if version < 4:
        return gzip.compress(
            struct.pack("<IIIBBBB", 0x5053474E, version, 2, 1, 12, 1, 0) + b"".join(streams) + b"more"
        )
    zstandard = pytest.importorskip("zstandard")
    packed = [zstandard.ZstdCompressor().compress(each) for each in streams]
    head = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 2, 1, 12, 1, 6, 40) + b"extended"
    return (
        head
        + b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
        + b"".join(packed)
    )


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_every_version_of_spz(version: int, tmp_path: Path) -> None:
    (tmp_path / "x.spz").write_bytes(older_spz(version))
    capture = read_capture(tmp_path / "x.spz")
    found = capture.gaussians
    assert capture.antialiased and found.degree == 1
    sign = torch.tensor([1.0, -1.0, -1.0] if version < 3 else [1.0, 1.0, 1.0])
    assert torch.equal(found.means, torch.tensor([[1.0, 2.0, -3.0], [0.5, 0.0, 0.25]]) * sign), (
        "apps write right up back, converters the axes of a PLY"
    )
    assert len(capture.notes) == 1
    assert torch.equal(found.log_scales[0], torch.tensor([0.0, -1.0, -2.0]))
    assert found.opacities[1] == pytest.approx(0.2, abs=1e-6) and found.opacities[0] > 0.99999
    turn = [[0, 1, 0, 0], [0, 0, -1, 0]] if version < 3 else [[1, 0, 0, 0], [0, 1, 0, 0]]
    assert torch.allclose(found.quaternions, torch.tensor(turn).float(), atol=0.1)
    assert torch.equal(found.harmonics[0, 1:, 0] * 128, torch.tensor([-8.0, -5.0, -2.0]) * sign[[1, 2, 0]])
    new = found.harmonics.clone()
    new[1] = 0.25
    again = restyled(tmp_path / "y.spz", capture, new)
    assert torch.equal(again.gaussians.harmonics[0], found.harmonics[0])
    assert (again.gaussians.harmonics - new).abs().max() < 0.5 / 255 / 0.15
    assert (b"extended" in again.data) if version == 4 else gzip.decompress(again.data).endswith(b"more")


def test_sog_of_version_1(tmp_path: Path) -> None:
    path = tmp_path / "x.sog"
    parts = unbundle(path, written(path, cloud(1, 40)).data)
    meta = json.loads(parts["meta.json"])
    old = {"means": meta["means"] | {"shape": [40, 3]}, "quats": meta["quats"]}
    old["scales"] = {"mins": [-6, -6, -6], "maxs": [0, 0, 0], "files": ["scales.webp"]}
    old["sh0"] = {"mins": [-1, -1, -1, -5], "maxs": [1, 1, 1, 5], "files": ["sh0.webp"]}
    old["shN"] = {"mins": -2.0, "maxs": 2.0, "quantization": 8, "files": meta["shN"]["files"]}
    for name, content in parts.items():
        (tmp_path / name).write_bytes(content if name != "meta.json" else json.dumps(old).encode())
    capture = read_capture(tmp_path)
    pixels = cv2.cvtColor(
        cv2.imread(str(tmp_path / "sh0.webp"), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA
    ).reshape(-1, 4)[:40]
    assert np.allclose(capture.gaussians.harmonics[:, 0], pixels[:, :3] / 255 * 2 - 1, atol=1e-6)
    assert np.allclose(capture.gaussians.logits, pixels[:, 3] / 255 * 10 - 5, atol=1e-6)
    new = capture.gaussians.harmonics * 0.5
    again = restyled(tmp_path / "there" / "meta.json", capture, new).gaussians
    assert (again.harmonics - new).abs().max() < 2 / 255 and torch.equal(
        again.logits, capture.gaussians.logits
    )


def test_what_is_refused_is_refused_in_one_line(tmp_path: Path) -> None:
    data, spz, sog = (
        written(tmp_path / f"x{ending}", cloud(1, 4)).data for ending in (".ply", ".spz", ".sog")
    )
    for name, content in (
        ("1d.ply", data.replace(b"scale_1", b"scale_9")),
        ("text.ply", data.replace(b"binary_little_endian", b"ascii")),
        ("short.ply", data[:-1]),
        ("transparent.ply", data.replace(b"opacity", b"opaque_")),
        ("degree.ply", data.replace(b"f_rest_8", b"g_rest_8")),
        ("x.obj", data),
        ("x.splat", b"abc"),
        ("short.spz", spz[:-24]),
        ("other.spz", data),
        ("short.sog", sog[:-9]),
        ("meta.json", b"{}"),
        ("none/x.ply", None),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError) as told:
            read_capture(tmp_path / name)
        assert "\n" not in str(told.value) and name in str(told.value)
    with pytest.raises(DataError):
        replace(cloud(0, 3), harmonics=torch.zeros(3, 2, 3))


@pytest.mark.parametrize("ending", [".spz", ".sog"])
def test_a_small_file_that_claims_much_takes_no_memory(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"x{ending}"
    if ending == ".spz":
        path.write_bytes(
            gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 2**30, 3, 12, 0, 0) + bytes(1 << 20))
        )
    else:
        parts = unbundle(path, written(path, cloud(0, 40)).data)
        wide = cv2.imencode(".webp", np.zeros((4000, 4000, 4), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])[
            1
        ].tobytes()
        meta = parts["meta.json"].replace(b'"count":40', b'"count":16000000')
        path.write_bytes(bundle(parts | {"means_l.webp": wide, "meta.json": meta}))
    tracemalloc.start()
    with pytest.raises(DataError):
        read_capture(path)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()
