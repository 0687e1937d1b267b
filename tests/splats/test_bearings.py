"""North and up in files of Gaussians, in runs, and through them."""

import json
import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_ball import ball

import fprf
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import DataError
from fprf.rendering.north import Bearings, North
from fprf.splats.capture_alignment import axes_of
from fprf.splats.captures import open_capture, with_asked_north
from fprf.splats.config import LookConfig
from fprf.splats.files import read_capture, write_capture, write_gaussians
from fprf.splats.gaussians import GaussianRows, Gaussians
from fprf.splats.relighting import facing_north
from fprf.training.facts import facts_from_json, facts_to_json
from fprf.training.prepare import facts_of

NORTH = (0.6, 0.0, -0.8)
UP = (0.0, 0.0, 1.0)
SAYS_IT = ("a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.glb", "a.gltf", "meta.json")


def told(gaussians: Gaussians, bearings: Bearings | None = None) -> GaussianRows:
    """All rows of some Gaussians that say where north is."""
    return GaussianRows(len(gaussians), gaussians.select, False, bearings or Bearings(NORTH, UP))


def north_of(path: Path) -> tuple[float, float, float] | None:
    north = read_capture(path).north
    return None if north is None else north.direction


@pytest.mark.parametrize("name", SAYS_IT)
def test_a_file_says_where_north_and_up_are(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write_gaussians(path, told(ball(300)))
    found = read_capture(path)
    assert found.north is not None and found.north.direction == pytest.approx(NORTH, abs=1e-6)
    assert axes_of(found).up == pytest.approx(UP, abs=1e-6)
    assert found.north.southern is None and len(found.gaussians) == 300
    # Recoloured in its own format it goes on saying so.
    write_capture(path, found, 0.5 * found.gaussians.harmonics)
    assert north_of(path) == pytest.approx(NORTH, abs=1e-6)
    # Without them a file says nothing, and is what it was.
    write_gaussians(path, ball(300))
    plain = read_capture(path)
    assert plain.north is None
    write_gaussians(path, told(ball(300), Bearings(NORTH, None)))
    assert read_capture(path).up is None and north_of(path) == pytest.approx(NORTH, abs=1e-6)
    assert torch.equal(read_capture(path).gaussians.means, plain.gaussians.means)


@pytest.mark.parametrize("last", SAYS_IT)
def test_north_goes_from_format_to_format(tmp_path: Path, last: str) -> None:
    write_gaussians(tmp_path / "first.ply", told(ball(300)))
    capture = read_capture(tmp_path / "first.ply")
    write_capture(tmp_path / "second.spz", capture, 0.5 * capture.gaussians.harmonics)
    capture = read_capture(tmp_path / "second.spz")
    write_capture(tmp_path / last, capture, capture.gaussians.harmonics)
    assert north_of(tmp_path / last) == pytest.approx(NORTH, abs=1e-6)


def test_a_format_without_a_place_for_it_is_written_all_the_same(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.splat", told(ball(300)))
    assert north_of(tmp_path / "a.splat") is None


def test_rows_of_a_large_capture_say_it_once(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", told(ball(300)))
    assert (tmp_path / "a.ply").read_bytes().count(b"comment North: 0.6 0 -0.8\n") == 1
    assert north_of(tmp_path / "a.ply") == pytest.approx(NORTH)


@pytest.mark.parametrize("said", ["nowhere", "0 0 0", "1 2", "nan 0 0", "1e400 0 0", "side of the house", ""])
def test_what_is_no_direction_is_passed_over(tmp_path: Path, said: str) -> None:
    write_gaussians(tmp_path / "a.ply", ball(300))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"1.0\n", f"1.0\ncomment north: {said}\n".encode(), 1))
    assert north_of(tmp_path / "a.ply") is None
    numbers = [float(word) if word.replace(".", "").isdigit() else word for word in said.split()]
    write_gaussians(tmp_path / "a.glb", told(ball(300)))
    data = (tmp_path / "a.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    document["nodes"][0]["extras"]["fprf"]["north"] = numbers
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, len(data) + len(text) - size, len(text), 0x4E4F534A)
    (tmp_path / "a.glb").write_bytes(head + text + data[20 + size :])
    assert north_of(tmp_path / "a.glb") is None


def test_a_spz_without_axes_is_read_with_its_extension(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.spz", told(ball(300)))
    whole = zlib.decompress((tmp_path / "a.spz").read_bytes(), wbits=31)
    # The extension of its axes is cut out: their number is guessed, and north is turned along.
    axes = struct.pack("<III", 0xADBE0003, 4, 6)
    assert axes in whole
    turned = struct.pack("<III", 0xADBE0003, 4, 4)  # right up back
    (tmp_path / "a.spz").write_bytes(zlib.compress(whole.replace(axes, turned), wbits=31))
    assert north_of(tmp_path / "a.spz") == pytest.approx((0.6, 0.0, 0.8), abs=1e-6)


def test_a_capture_that_is_turned_as_a_whole_keeps_its_north(tmp_path: Path) -> None:
    """Files whose directions say the same of a turned world show the same azimuths."""
    shape = ball(2000, 1)
    angles = []
    for quarter in range(2):
        # A quarter turn about y, which points down.
        turn = torch.linalg.matrix_power(
            torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), quarter
        )
        half = math.pi / 4 * quarter
        w, x, y, z = shape.quaternions.unbind(1)
        c, s = math.cos(half), math.sin(half)
        turned = torch.stack([c * w - s * y, c * x + s * z, c * y + s * w, c * z - s * x], 1)
        moved = replace(shape, means=shape.means @ turn.T, quaternions=turned)
        north = turn @ torch.tensor(NORTH)
        bearings = Bearings((float(north[0]), float(north[1]), float(north[2])), (0.0, -1.0, 0.0))
        write_gaussians(tmp_path / f"{quarter}.ply", told(moved, bearings))
        capture = read_capture(tmp_path / f"{quarter}.ply")
        scene = open_capture(capture, LookConfig(views=4, size=(64, 48)), cache=tmp_path / "cache")
        assert scene.north == capture.north
        known = facing_north(scene.light_found, scene.north)
        thing = turn @ torch.tensor([1.0, -1.0, 2.0])
        angles.append(known.degrees_of(torch.nn.functional.normalize(thing, dim=0)))
    assert angles[0] == pytest.approx(angles[1], abs=1e-2)
    # With y down east lies to the right of north as x to that of z: of x and z (-0.8, -0.6).
    wanted = math.degrees(math.atan2(-0.8 * 1 - 0.6 * 2, 0.6 * 1 - 0.8 * 2))
    assert angles[0][0] == pytest.approx(wanted, abs=1e-2)


def test_north_is_where_the_user_says(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", told(ball(500)))
    capture = read_capture(tmp_path / "a.ply")
    look = LookConfig(views=4, size=(64, 48), north=(0.0, 0.0, 5.0))
    scene = open_capture(capture, look, cache=tmp_path / "cache")
    assert scene.north is not None and scene.north.direction == (0, 0, 1)
    read = fprf.read(tmp_path / "a.ply", north=[1, 0, 0])
    assert read.capture.north is not None and read.capture.north.direction == (1, 0, 0)
    with pytest.raises(DataError, match="north"):
        with_asked_north(capture, replace(look, north=(0.0, 0.0, 0.0)))


def test_facts_of_a_run_keep_north_and_up(scene: ParsedScene) -> None:
    north = North(direction=NORTH, source="a compass", southern=True)
    facts = facts_of(replace(scene, north=north, up=UP))
    assert facts.up == UP
    assert facts.north is not None and facts.north.direction == NORTH
    document = json.loads(json.dumps(facts_to_json(facts)))
    assert facts_from_json(document) == facts
    # Files of before say nothing.
    del document["north"]
    del document["up"]
    assert facts_from_json(document) == replace(facts, north=None, up=None) == facts_of(scene)
