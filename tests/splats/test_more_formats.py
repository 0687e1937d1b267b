"""glTF, .ksplat and streamed SOG: what other programs write, made by hand after their specifications."""

import base64
import json
import math
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splat_ball import ball, equal, plain_ply
from test_files import cloud

from fprf.errors import DataError
from fprf.ops.harmonics import spherical_harmonics
from fprf.rendering.splines import rotations
from fprf.splats.files import read_capture, write_capture, write_gaussians
from fprf.splats.files.sog_archive import unbundle
from fprf.splats.gaussians import Gaussians


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def glb_of(document: dict[str, Any], body: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(body), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(body), b"BIN\0") + body


def covariances(gaussians: Gaussians) -> torch.Tensor:
    half = rotations(gaussians.quaternions.double()) * gaussians.log_scales.double().exp()[:, None]
    return half @ half.mT


def seen_along(gaussians: Gaussians, direction: torch.Tensor) -> torch.Tensor:
    values = spherical_harmonics(direction.double(), gaussians.degree + 1)
    return torch.einsum("dk,nkc->dnc", values, gaussians.harmonics.double())


def test_a_glb_of_more_than_its_lengths_can_say_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fprf.splats.files.gltf._MAX_BUFFER_BYTES", 1000)
    with pytest.raises(DataError, match=r"\.ply or \.spz"):
        write_gaussians(tmp_path / "x.glb", ball(40))


def test_a_glb_has_what_the_extension_demands(tmp_path: Path) -> None:
    made = cloud(3, 50)
    write_gaussians(tmp_path / "x.glb", made)
    data = (tmp_path / "x.glb").read_bytes()
    document, body = glb_parts(data)
    assert struct.unpack_from("<I", data, 8)[0] == len(data) and len(data) % 4 == 0
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    assert len(primitive["attributes"]) == 5 + 16

    def column(name: str) -> np.ndarray:
        about = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][about["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and about["count"] == 50
        kind = "u1" if about["componentType"] == 5121 else "<f4"
        return np.frombuffer(body[view["byteOffset"] :][: view["byteLength"]], kind).reshape(50, -1)

    assert np.array_equal(column("POSITION"), made.means)
    assert np.allclose(column("KHR_gaussian_splatting:SCALE"), made.log_scales.exp(), rtol=1e-6), "linear"
    assert np.allclose(column("KHR_gaussian_splatting:ROTATION")[:, 3], made.quaternions[:, 0], atol=1e-6), (
        "w is last"
    )
    assert np.allclose(column("KHR_gaussian_splatting:OPACITY")[:, 0], made.opacities, atol=1e-6)
    assert np.array_equal(column("KHR_gaussian_splatting:SH_DEGREE_2_COEF_3"), made.harmonics[:, 7])
    assert np.allclose(column("COLOR_0")[:, :3] / 255, made.colours.clamp(0, 1), atol=0.51 / 255)


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize(
    ("generator", "space"),
    [(None, None), ("tool 1.0", "srgb_rec709_display"), ("splat-transform 2.{}.1", None), (None, "BT.709")],
)
def test_linear_and_logarithmic_sizes_are_told_apart(
    unit: float, logarithmic: bool, generator: str | None, space: str | None, tmp_path: Path
) -> None:
    """By a negative one, by what wrote the file, by the draft's colour space, or by what fits the distances
    between them.
    """
    if space == "BT.709" and not logarithmic:
        pytest.skip("no file of a draft has linear sizes")
    made = ball(400)
    path = tmp_path / "x.glb"
    made = replace(made, means=made.means * unit, log_scales=made.log_scales - 0.7 + math.log(unit))
    write_gaussians(path, made)
    assert "fprf wrote it" in read_capture(path).notes[0]
    document, body = glb_parts(path.read_bytes())
    extension = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    extension["colorSpace"] = space or "srgb_rec709_display"
    document["asset"]["generator"] = (generator or "").format(6 if logarithmic else 7)
    view = document["bufferViews"][2]
    sizes = made.log_scales if logarithmic else made.log_scales.exp()
    body = (
        body[: view["byteOffset"]] + sizes.numpy().tobytes() + body[view["byteOffset"] + view["byteLength"] :]
    )
    path.write_bytes(glb_of(document, body))
    found = read_capture(path)
    assert torch.allclose(found.gaussians.log_scales, made.log_scales, atol=1e-5), found.notes
    assert ("review draft" in found.notes[0]) == logarithmic and "\n" not in found.notes[0]
    positive = unit == 100
    assert not positive or bool((sizes > 0).all())
    told = {"tool 1.0": "neighbours", None: "BT.709" if space else "neighbours"}.get(
        generator, "splat-transform"
    )
    assert ("negative" if logarithmic and not positive else told) in found.notes[0]


def test_whole_numbers_of_sizes_are_shares_only_where_they_are_said_to_be(tmp_path: Path) -> None:
    """The review draft allows logarithms as bytes."""
    made = ball(40)
    path = tmp_path / "x.glb"
    made = replace(made, log_scales=made.log_scales.round())
    write_gaussians(path, made)
    document, body = glb_parts(path.read_bytes())
    sizes = np.zeros((40, 4), np.int8)
    sizes[:, :3] = made.log_scales.numpy()
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": 160, "byteStride": 4})
    document["accessors"][2] |= {"bufferView": len(document["bufferViews"]) - 1, "componentType": 5120}
    path.write_bytes(glb_of(document, body + sizes.tobytes()))
    assert torch.allclose(read_capture(path).gaussians.log_scales, made.log_scales, atol=1e-6)


def test_nodes_turn_scale_and_move_gaussians_and_their_harmonics(tmp_path: Path) -> None:
    """As baked into the Gaussians: positions, shapes and what is seen along directions."""
    made = cloud(3, 40)
    path = tmp_path / "x.glb"
    write_gaussians(path, made)
    document, body = glb_parts(path.read_bytes())
    turn = torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.2, 0.7]]).double())
    document["nodes"] = [
        {"children": [1], "scale": [2, 2, 2], "rotation": [*turn[0, 1:].tolist(), float(turn[0, 0])]},
        {"mesh": 0, "translation": [1, 2, 3]},
        {"camera": 0},
    ]
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}]
    path.write_bytes(glb_of(document, body))
    capture = read_capture(path)
    found = capture.gaussians
    front = torch.diag(torch.tensor([1.0, -1.0, -1.0]).double())
    change = front @ rotations(turn)[0]
    assert torch.allclose(
        found.means.double(), 2 * (made.means.double() + torch.tensor([1, 2, 3])) @ change.T, atol=1e-5
    )
    assert torch.allclose(covariances(found), 4 * change @ covariances(made) @ change.T, rtol=1e-4)
    directions = torch.nn.functional.normalize(torch.randn(30, 3).double(), dim=1)
    assert torch.allclose(seen_along(found, directions @ change.T), seen_along(made, directions), atol=1e-5)
    new = found.harmonics * 0.5
    write_capture(tmp_path / "y.glb", capture, new)
    again = read_capture(tmp_path / "y.glb")
    assert torch.equal(again.gaussians.means, found.means) and torch.allclose(
        again.gaussians.harmonics, new, atol=1e-5
    )
    kept, _ = glb_parts((tmp_path / "y.glb").read_bytes())
    assert kept == document, "nodes and cameras stay"
    document["nodes"][0]["scale"] = [2, 2, 1]
    path.write_bytes(glb_of(document, body))
    with pytest.raises(DataError, match="shears"):
        read_capture(path)


def test_several_primitives_quantised_attributes_and_files_beside(tmp_path: Path) -> None:
    made = ball(40)
    path = tmp_path / "x.gltf"
    write_gaussians(tmp_path / "x.glb", made)
    document, body = glb_parts((tmp_path / "x.glb").read_bytes())
    primitive = document["meshes"][0]["primitives"][0]
    turns = np.rint(np.frombuffer(body, "<f4", 160, document["bufferViews"][1]["byteOffset"]) * 32767).astype(
        "<i2"
    )
    extra = turns.tobytes()
    document["bufferViews"].append({"buffer": 1, "byteLength": len(extra)})
    document["accessors"].append(
        {"bufferView": len(document["bufferViews"]) - 1, "componentType": 5122, "count": 40, "type": "VEC4"}
    )
    document["accessors"][-1]["normalized"] = True
    rotation = {"KHR_gaussian_splatting:ROTATION": len(document["accessors"]) - 1}
    # The second primitive has all but its rotations in a copy of the first one's bytes.
    first = len(document["accessors"])
    for view, accessor in zip(document["bufferViews"][:-1], document["accessors"][:-1], strict=True):
        document["accessors"].append(accessor | {"bufferView": len(document["bufferViews"])})
        document["bufferViews"].append(view | {"byteOffset": view["byteOffset"] + len(body)})
    copied = {name: first + k for name, k in primitive["attributes"].items()}
    document["meshes"].append({"primitives": [primitive | {"attributes": copied | rotation}]})
    document["nodes"].append({"mesh": 1, "rotation": [1, 0, 0, 0], "translation": [5, 0, 0]})
    document["scenes"][0]["nodes"] = [0, 1]
    document["buffers"][0]["uri"] = "my%20scan.bin"
    document["buffers"].append(
        {"byteLength": len(extra), "uri": "data:;base64," + base64.b64encode(extra).decode()}
    )
    (tmp_path / "my scan.bin").write_bytes(2 * body)
    path.write_text(json.dumps(document))
    capture = read_capture(path)
    first, second = (capture.gaussians.select(slice(start, start + 40)) for start in (0, 40))
    assert torch.equal(first.means, made.means) and torch.allclose(
        second.means - torch.tensor([5.0, 0, 0]), made.means, atol=1e-6
    )
    assert torch.allclose(covariances(second), covariances(first), rtol=1e-2, atol=1e-6)
    new = capture.gaussians.harmonics * torch.tensor([0.5, 0.25]).repeat_interleave(40)[:, None, None]
    write_capture(tmp_path / "there" / "y.gltf", capture, new)
    again = read_capture(tmp_path / "there" / "y.gltf").gaussians
    assert torch.allclose(again.harmonics, new, atol=1e-6) and torch.equal(
        again.means, capture.gaussians.means
    )
    document["buffers"][0]["uri"] = "%2e%2e/my%20scan.bin"
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match="beside"):
        read_capture(path)


def test_linear_colours_come_out_as_srgb_and_go_back(tmp_path: Path) -> None:
    made = ball(40)
    path = tmp_path / "x.glb"
    write_gaussians(path, made)
    document, body = glb_parts(path.read_bytes())
    document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["colorSpace"] = (
        "lin_rec709_display"
    )
    path.write_bytes(glb_of(document, body))
    capture = read_capture(path)
    linear = made.colours.clamp_min(0)
    wanted = torch.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-9) ** (1 / 2.4) - 0.055
    )
    assert torch.allclose(capture.gaussians.colours, wanted, atol=1e-5)
    new = capture.gaussians.harmonics * 0.9
    write_capture(tmp_path / "y.glb", capture, new)
    assert torch.allclose(read_capture(tmp_path / "y.glb").gaussians.harmonics, new, atol=1e-4)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["meshes"][0]["primitives"][0].pop("extensions"),
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("KHR_gaussian_splatting:SCALE"),
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(
            "KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"
        ),
        lambda d: d["accessors"][0].update(count=10**9),
        lambda d: d["bufferViews"][1].update(byteOffset=-4),
        lambda d: d["nodes"][0].update(children=[0]),
        lambda d: d.update(nodes=2 * d["nodes"], scenes=[{"nodes": [0, 1]}]),
        lambda d: d.update(scene=7),
        lambda d: d["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"].update(
            extensions={"packed": {}}
        ),
    ],
)
def test_an_unsound_gltf_is_refused_in_one_line(change: Any, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "x.glb", ball(40))
    document, body = glb_parts((tmp_path / "x.glb").read_bytes())
    change(document)
    (tmp_path / "x.glb").write_bytes(glb_of(document, body))
    with pytest.raises(DataError) as told:
        read_capture(tmp_path / "x.glb")
    assert "\n" not in str(told.value) and "x.glb" in str(told.value)


def ksplat_of(made: Gaussians, compression: int, bucket: int = 16, block: float = 5.0) -> bytes:
    """Two sections: all but ten in buckets of 16, the last of which is not full, and ten in one bucket."""
    head = struct.pack(
        "<BBxxIIIIHxxfff", 0, 1, 3, 2, len(made), len(made), compression, 0, 0, 0
    ) + struct.pack("<ff", -2, 2)
    sections = b""
    bodies = b""
    for part in (made.select(slice(0, len(made) - 10)), made.select(slice(len(made) - 10, None))):
        count = len(part)
        full, left = divmod(count, bucket)
        centres = np.stack(
            [part.means[k : k + bucket].mean(0).numpy() for k in range(0, count, bucket)]
        ).astype("<f4")
        first, half = ("<f4", "<f4") if compression == 0 else ("<u2", "<f2")
        rest = made.degree * (made.degree + 2) * 3
        kinds = [("mean", first, 3), ("scale", half, 3), ("turn", half, 4), ("rgba", "u1", 4)]
        table = np.zeros(count + 3, np.dtype([*kinds, ("rest", "u1" if compression == 2 else half, rest)]))[
            : count + 3
        ]
        means = part.means.numpy()
        if compression:
            means = np.rint((means - centres[np.arange(count) // bucket]) / (block / 2) * 32767 + 32767)
        rows = table[:count]
        rows["mean"] = means
        rows["scale"] = part.log_scales.exp().numpy()
        rows["turn"] = part.quaternions.numpy()
        rows["rgba"] = np.rint(
            255 * torch.cat([part.colours.clamp(0, 1), part.opacities[:, None]], 1).numpy()
        )
        bands = [part.harmonics[:, a:b].transpose(1, 2).flatten(1) for a, b in ((1, 4), (4, 9))]
        values = torch.cat(bands, 1).numpy()[:, :rest]
        rows["rest"] = np.rint((values + 2) / 4 * 255) if compression == 2 else values
        stored = 0 if compression == 0 else 12
        partial = int(left > 0)
        numbers = (count, count + 3, bucket, len(centres), block, stored, 0, 0, full, partial, made.degree)
        sections += struct.pack("<IIIIfHxxIIIIH", *numbers).ljust(1024, b"\0")
        bodies += (
            struct.pack("<I", left) * partial + (centres.tobytes() if compression else b"") + table.tobytes()
        )
    return head.ljust(4096, b"\0") + sections + bytes(1024) + bodies


@pytest.mark.parametrize("compression", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_ksplat_is_read_within_its_steps(compression: int, degree: int, tmp_path: Path) -> None:
    made = cloud(degree, 75)
    made.harmonics[:, 0] = made.harmonics[:, 0].clamp(-1.7, 1.7)
    path = tmp_path / "x.ksplat"
    path.write_bytes(ksplat_of(made, compression))
    capture = read_capture(path)
    found = capture.gaussians
    assert torch.allclose(found.means, made.means, atol=1e-6 if compression == 0 else 5 / 65534)
    assert torch.allclose(found.log_scales, made.log_scales, atol=1e-3) and found.degree == degree
    assert (found.colours - made.colours.clamp(0, 1)).abs().max() <= 0.51 / 255
    assert torch.allclose(
        found.harmonics[:, 1:], made.harmonics[:, 1:], atol=(1e-6, 1e-3, 0.5 * 4 / 255 + 1e-6)[compression]
    )
    write_capture(tmp_path / "y.ply", capture, found.harmonics * 0.5)
    assert torch.equal(read_capture(tmp_path / "y.ply").gaussians.means, found.means)
    data = path.read_bytes()
    for wrong in (
        data[: len(data) // 2],
        data[:5000],
        data[:20] + b"\7" + data[21:],
        data[:16] + b"\1" + data[17:],
    ):
        path.write_bytes(wrong)
        with pytest.raises(DataError):
            read_capture(path)
    with pytest.raises(DataError, match="not written"):
        write_gaussians(tmp_path / "y.ksplat", made)


def test_a_streamed_sog_is_read_at_its_finest_level(tmp_path: Path) -> None:
    chunks = {
        "0_0": ball(60, seed=1),
        "0_1": ball(40, seed=2),
        "1_0": ball(20, seed=3),
        "env": ball(10, seed=4),
    }
    found = {}
    for name, made in chunks.items():
        write_gaussians(tmp_path / name / "meta.json", made)
        found[name] = read_capture(tmp_path / name).gaussians
    leaves = [
        {"lods": {"0": {"file": 0, "offset": 0, "count": 35}, "1": {"file": 2, "offset": 0, "count": 20}}},
        {
            "children": [
                {"lods": {"0": {"file": 0, "offset": 35, "count": 25}}},
                {"lods": {"0": {"file": 1, "offset": 0, "count": 40}}},
            ]
        },
    ]
    index = {"version": 1, "lodLevels": 2, "environment": "env/meta.json", "tree": {"children": leaves}}
    index["filenames"] = [f"{name}/meta.json" for name in ("0_0", "0_1", "1_0")]
    path = tmp_path / "lod-meta.json"
    path.write_text(json.dumps(index))
    capture = read_capture(path)
    parts = [found[name] for name in ("0_0", "0_1", "env")]
    whole = Gaussians(
        *(torch.cat(each) for each in zip(*(vars(part).values() for part in parts), strict=True))
    )
    assert equal(capture.gaussians, whole)
    write_capture(tmp_path / "y.sog", capture, capture.gaussians.harmonics * 0.5)
    assert len(read_capture(tmp_path / "y.sog").gaussians) == 110
    assert len(unbundle(path, bytes(capture.data))) == 4
    for wrong in (
        {"version": 2},
        {"tree": {}, "environment": None},
        {"filenames": ["../x/meta.json"] * 3},
        {"filenames": []},
        {"filenames": ["1_0/meta.json"] * 3},
        {"filenames": ["0_0/meta.json", "./0_0/meta.json", "1_0/meta.json"]},
        {"tree": {"children": leaves + leaves}},
    ):
        path.write_text(json.dumps(index | wrong))
        with pytest.raises(DataError):
            read_capture(path)


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["splat", "ksplat", "sog"])
def test_gaussforge_and_we_agree(ending: str, tmp_path: Path) -> None:
    """What gaussforge (0.6.0) writes from a .ply we read as it does itself, by way of a .ply again.

    Its .spz keeps the axes of the .ply, while the format's own are right up back.
    """
    forge = pytest.importorskip("gaussforge").GaussForge()
    made = cloud(0 if ending == "splat" else 2, 300)
    theirs = forge.convert(plain_ply(made), "ply", ending)["data"]
    (tmp_path / f"x.{ending}").write_bytes(theirs)
    (tmp_path / "y.ply").write_bytes(forge.convert(theirs, ending, "ply")["data"])
    ours, wanted = (read_capture(tmp_path / name).gaussians for name in (f"x.{ending}", "y.ply"))
    assert len(ours) == len(wanted) == 300
    order = torch.cdist(ours.means, wanted.means).argmin(1)
    assert torch.allclose(ours.means, wanted.means[order], atol=1e-4)
    assert torch.allclose(covariances(ours), covariances(wanted.select(order)), rtol=0.02, atol=1e-5)
    assert (ours.colours - wanted.colours[order]).abs().max() < 0.01
    assert (ours.opacities - wanted.opacities[order]).abs().max() < 0.01


@pytest.mark.parametrize("degree", [0, 3, 4])
def test_a_usdz_holds_what_its_schema_names(degree: int, tmp_path: Path) -> None:
    """As usd-core reads it: shapes and what is seen along directions, in axes right up back."""
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    made = cloud(degree, 50)
    path = tmp_path / "x.usdz"
    write_gaussians(path, made)
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and UsdGeom.GetStageUpAxis(stage) == "Y"
    names = ("positions", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
    means, sizes, opacities, harmonics = (
        torch.tensor(np.array(prim.GetAttribute(name).Get())) for name in names
    )
    turns = torch.tensor([[q.real, *q.imaginary] for q in prim.GetAttribute("orientations").Get()])
    kept = min(degree, 3)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == kept
    read = Gaussians(means, turns, sizes.log(), opacities.logit(), harmonics.reshape(50, (kept + 1) ** 2, 3))
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    assert torch.allclose(read.means, made.means @ turn) and torch.allclose(
        read.opacities, made.opacities, atol=1e-6
    )
    assert torch.allclose(
        covariances(read), turn.double() @ covariances(made) @ turn.double(), rtol=1e-4, atol=1e-9
    )
    directions = torch.nn.functional.normalize(torch.randn(30, 3).double(), dim=1)
    made = made.recoloured(made.harmonics[:, : (kept + 1) ** 2])
    assert torch.allclose(
        seen_along(read, directions @ turn.double()), seen_along(made, directions), atol=1e-5
    )
    with pytest.raises(DataError, match="not read"):
        read_capture(path)


def test_without_usd_core_one_line_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(DataError, match="pip install usd-core"):
        write_gaussians(tmp_path / "x.usdz", ball(10))
    assert not (tmp_path / "x.usdz").exists()
