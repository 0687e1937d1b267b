"""What points up where all photographs look one way and are held alike: flights straight down, and walls."""

import io
import math
from dataclasses import replace
from pathlib import Path

import PIL.Image
import pytest
import torch
from capture_files import Capture, write_odm, write_transforms
from test_positions import LUND, METRES_PER_DEGREE, block
from torch import Tensor

from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.positions import Position
from fprf.datamanagers.scene import ParsedScene
from fprf.datamanagers.up_direction import UP_NOTE, read_pitch, with_up
from fprf.errors import DataError
from fprf.rendering.cameras import ideal_cameras
from fprf.rendering.north import world_axes
from fprf.rendering.splines import rotations

DOWN = torch.eye(3).double()
"""Axes of a camera that looks down: x east, y north, z up."""
LEVEL = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()
"""Axes (columns) of a camera that looks north: x east, y up, z south."""
WORLD = rotations(torch.tensor([[0.4, -0.3, 0.8, 0.33]], dtype=torch.float64))[0]
UP = WORLD[:, 2]
TURNED = torch.diag(torch.tensor([-1.0, -1, 1])).double()
"""Half a turn of a camera about its view."""


def scanned(
    axes: Tensor,
    *,
    columns: int = 6,
    rows: int = 4,
    step: float = 0.25,
    jitter: float = 0.0,
    to_and_fro: bool = False,
) -> ParsedScene:
    """A grid of cameras of given axes in a turned world, which see a plane at 1 whose shorter side is 0.8; a step is a
    share of that side.
    """
    draw = torch.Generator().manual_seed(0)
    places = []
    turns = []
    for k in range(columns * rows):
        places.append(torch.tensor([k % columns, k // columns, 0.0]).double() * 0.8 * step)
        shaken = torch.tensor([1.0, *(0.5 * math.radians(jitter) * torch.randn(3, generator=draw))]).double()
        turn = axes @ rotations(shaken[None])[0]
        turns.append(turn @ TURNED if to_and_fro and k // columns % 2 else turn)
    place = (torch.stack(places) - torch.stack(places).mean(0)) @ axes.T
    flat = (torch.rand(500, 2, generator=draw).double() - 0.5) * 6
    points = torch.cat([flat, -torch.ones(500, 1).double()], 1) @ axes.T
    pose = torch.cat([WORLD @ torch.stack(turns), (place @ WORLD.T)[..., None]], 2)
    cameras = ideal_cameras(pose, 20.0, (24, 16))
    paths = tuple(Path(f"none/{k:03d}.jpg") for k in range(len(pose)))
    every = torch.arange(len(pose))
    return ParsedScene(
        name="grid", paths=paths, cameras=cameras, train=every, test=every[:0], points=points @ WORLD.T
    )


def tilt(scene: ParsedScene) -> float:
    """Degrees between what is taken for up and what is."""
    up = world_axes(scene.cameras, scene.up)[0].double()
    return math.degrees(math.acos(max(-1.0, min(1.0, float(up @ UP)))))


def notes(scene: ParsedScene) -> list[str]:
    return [note for note in scene.notes if note.startswith(UP_NOTE)]


@pytest.mark.parametrize("to_and_fro", [False, True])
@pytest.mark.parametrize("jitter", [0.0, 0.3, 2.0])
def test_a_flight_of_one_heading_has_up_against_its_view(jitter: float, to_and_fro: bool) -> None:
    flight = scanned(DOWN, jitter=jitter, to_and_fro=to_and_fro)
    found = with_up(flight)
    assert tilt(found) < 1 + jitter
    assert len(notes(found)) == 1 and "--up" in notes(found)[0]
    if not to_and_fro and not jitter:
        assert tilt(flight) > 60, "as cameras are held level"


@pytest.mark.parametrize("step", [0.02, 0.08])
def test_cameras_before_a_wall_are_held_level(step: float) -> None:
    """Forward-facing captures move little over what they see."""
    wall = scanned(LEVEL, step=step, jitter=1.0)
    assert with_up(wall) is wall


def test_a_walk_along_a_wall_is_no_flight_but_a_line_says_so() -> None:
    walk = with_up(scanned(LEVEL, rows=1, columns=12, jitter=1.0))
    assert walk.up is None and len(notes(walk)) == 1 and "--up" in notes(walk)[0]


def test_other_captures_say_nothing() -> None:
    """Views of several directions or headings, and too few."""
    flight = scanned(DOWN)
    around = flight.cameras.pose.clone()
    around[::3, :, :3] = around[::3, :, :3] @ rotations(torch.tensor([[0.8, 0, 0, 0.6]]).double())
    many = replace(flight, cameras=replace(flight.cameras, pose=around))
    assert with_up(many) is many and tilt(many) < 1
    few = replace(flight, cameras=flight.cameras.select(torch.arange(3)), paths=flight.paths[:3])
    assert with_up(few) is few
    blind = replace(flight, points=None)
    assert with_up(blind) is blind


def photographed(
    scene: ParsedScene, folder: Path, *, metres: float = 0.0, pitch: float | None = None
) -> ParsedScene:
    """The scene with photographs that have positions, of so many metres for 1, or the angle of a gimbal."""
    paths = []
    for k, place in enumerate((scene.cameras.pose[:, :, 3] @ WORLD).tolist()):
        path = folder / f"{k:03d}.jpg"
        xmp = (
            b""
            if pitch is None
            else f'<rdf:Description drone-dji:GimbalPitchDegree="{pitch:+.2f}"/>'.encode()
        )
        shrunk = METRES_PER_DEGREE * math.cos(math.radians(LUND.latitude))
        here = Position(
            LUND.latitude + metres * place[1] / METRES_PER_DEGREE, LUND.longitude + metres * place[0] / shrunk
        )
        PIL.Image.new("RGB", (8, 8)).save(path, exif=block(here) if metres else PIL.Image.Exif(), xmp=xmp)
        paths.append(path)
    return replace(scene, paths=tuple(paths))


@pytest.mark.parametrize("told", ["positions", "gimbal"])
def test_photographs_of_drones_tell_a_facade_from_the_ground(told: str, tmp_path: Path) -> None:
    """Which look the same but for a quarter turn of the world; here both move over what they see."""
    for axes, down in ((DOWN, True), (LEVEL, False)):
        pitch = None if told == "positions" else -89.7 if down else -1.5
        scene = photographed(scanned(axes, jitter=0.3), tmp_path, metres=60.0 * (pitch is None), pitch=pitch)
        found = with_up(scene)
        assert (found.up is not None) == down
        assert tilt(found) < 2 if down else not notes(found)
    # Without either they are taken for a flight.
    assert with_up(scanned(LEVEL)).up is not None


def test_the_angle_of_a_gimbal_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    for text, wanted in (
        (b'<a drone-dji:GimbalPitchDegree="-89.90"/>', -89.9),
        (b"<drone-dji:GimbalPitchDegree>+12.5</drone-dji:GimbalPitchDegree>", 12.5),
        (b'<a drone-dji:GimbalPitchDegree="down"/>', None),
        (b"<a/>", None),
    ):
        PIL.Image.new("RGB", (8, 8)).save(path, xmp=text)
        assert read_pitch(path) == wanted
    path.write_bytes(b"no image")
    assert read_pitch(path) is None and read_pitch(tmp_path / "none.jpg") is None
    data = io.BytesIO()
    PIL.Image.new("RGB", (8, 8)).save(data, "PNG")
    path.write_bytes(data.getvalue())
    assert read_pitch(path) is None


def test_up_is_as_asked_or_as_the_capture_says(tmp_path: Path) -> None:
    write_transforms(tmp_path / "plain", Capture.make(9))
    assert parse_scene(tmp_path / "plain", 1, None).up is None
    assert parse_scene(tmp_path / "plain", 1, None, (0.0, 0.0, 2.0)).up == (0.0, 0.0, 1.0)
    with pytest.raises(DataError, match="three numbers"):
        parse_scene(tmp_path / "plain", 1, None, (0.0, 0.0, 0.0))
    write_odm(tmp_path / "report", Capture.make(9), report=True)
    assert parse_scene(tmp_path / "report", 1, None).up == (0.0, 0.0, 1.0)
    assert parse_scene(tmp_path / "report", 1, None, (0.0, 1.0, 0.0)).up == (0.0, 1.0, 0.0)
