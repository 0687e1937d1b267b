"""Positions in EXIF blocks, and north of scene folders whose photographs have them."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import torch
from capture_files import Capture, write_odm, write_transforms
from PIL.ExifTags import GPS, IFD, Base
from raw_files import thumbnail, tiff

from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.positions import Position, north_of, read_position
from fprf.datamanagers.scene import ParsedScene
from fprf.rendering.north import world_axes

CAPE = Position(-33.9, 18.4)
LUND = Position(55.698, 13.195)
METRES_PER_DEGREE = 111_200.0


def dms(degrees: float) -> tuple[float, float, float]:
    minutes = abs(degrees) * 60
    return float(minutes // 60), float(minutes // 1 % 60), round(minutes % 1 * 60, 4)


def block(position: Position, **changes: Any) -> PIL.Image.Exif:
    exif = PIL.Image.Exif()
    exif[Base.Make] = "fprf"  # Pillow writes no block into a PNG that has tags of positions alone
    tags = {
        GPS.GPSLatitudeRef: "S" if position.latitude < 0 else "N",
        GPS.GPSLatitude: dms(position.latitude),
        GPS.GPSLongitudeRef: "W" if position.longitude < 0 else "E",
        GPS.GPSLongitude: dms(position.longitude),
    }
    for name, value in changes.items():
        tags[GPS[name]] = value
    exif.get_ifd(IFD.GPSInfo).update({tag: value for tag, value in tags.items() if value is not None})
    return exif


def geotag(path: Path, exif: PIL.Image.Exif) -> None:
    """Write an EXIF block into an image that is there."""
    data = io.BytesIO()
    PIL.Image.open(path).save(data, "PNG", exif=exif)
    path.write_bytes(data.getvalue())


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("position", [LUND, CAPE, Position(-12.05, -77.04), Position(21.3, -157.86)])
def test_a_position_is_read_from_any_format(tmp_path: Path, suffix: str, position: Position) -> None:
    path = tmp_path / f"a.{suffix}"
    PIL.Image.new("RGB", (8, 8)).save(path, exif=block(position, GPSAltitude=None))
    found = read_position(path)
    assert found == pytest.approx(position, abs=1e-7) and found is not None and found.accuracy == 0


@pytest.mark.parametrize(("said", "accuracy"), [(4.75, 4.75), (0.0, 0.0), (None, 0.0)])
def test_the_accuracy_of_a_receiver_is_read(tmp_path: Path, said: float | None, accuracy: float) -> None:
    path = tmp_path / "a.jpg"
    PIL.Image.new("RGB", (8, 8)).save(path, exif=block(LUND, GPSHPositioningError=said))
    found = read_position(path)
    assert found is not None and found.accuracy == pytest.approx(accuracy)


@pytest.mark.parametrize("raw", [False, True])
def test_a_position_is_read_from_tiff_and_raw_photographs(tmp_path: Path, raw: bool) -> None:
    pixels = np.zeros((4, 6, 3), np.uint8)
    first = thumbnail(pixels, reduced=False) | {34853: (4, ["inside"])}
    if raw:
        first |= {50706: (1, [1, 4, 0, 0]), 262: (3, [32803])}
    south = {1: (2, [b"S"]), 2: (5, [(33, 1), (54, 1), (36, 10)])}
    east = {3: (2, [b"E"]), 4: (5, [(18, 1), (24, 1), (0, 1)])}
    path = tmp_path / "a.dng"
    path.write_bytes(tiff(first, south | east, [pixels.tobytes()]))
    assert read_position(path) == pytest.approx((-33.901, 18.4, 0.0))


@pytest.mark.parametrize(
    "changes",
    [
        {"GPSLatitudeRef": "X"},
        {"GPSLatitudeRef": None},
        {"GPSLatitudeRef": ""},
        {"GPSLongitudeRef": "\0"},
        {"GPSLatitude": (91.0, 0.0, 0.0)},
        {"GPSLongitude": (181.0, 0.0, 0.0)},
        {"GPSLatitude": (55.0, 41.0)},
        {"GPSLatitude": (0.0, 0.0, 0.0), "GPSLongitude": (0.0, 0.0, 0.0)},
    ],
)
def test_what_is_no_position_is_none(tmp_path: Path, changes: dict[str, Any]) -> None:
    path = tmp_path / "a.jpg"
    PIL.Image.new("RGB", (8, 8)).save(path, exif=block(LUND, **changes))
    assert read_position(path) is None
    path.write_bytes(b"no image")
    assert read_position(path) is None and read_position(tmp_path / "none.jpg") is None


def walked(
    folder: Path, position: Position, heading: float, length: float = 80.0, noise: float = 0.0
) -> None:
    """Level cameras on a bent walk, all looking at compass directions around `heading`, y down, with their positions."""
    count = 12
    draw = np.random.default_rng(0)
    along = np.linspace(0, length, count)
    across = 0.05 * length * np.sin(along / length * 4)
    poses = np.zeros((count, 3, 4))
    for k in range(count):
        yaw = 0.3 * math.sin(k)
        poses[k, :, 0] = math.cos(yaw), 0, -math.sin(yaw)  # right; ahead is +z, up -y
        poses[k, :, 1] = 0, -1, 0
        poses[k, :, 2] = -math.sin(yaw), 0, -math.cos(yaw)
        poses[k, :, 3] = 0.3 * across[k], 5.0, 0.3 * along[k]
    capture = Capture(tuple(f"{k:04d}.png" for k in range(count)), poses, np.array([[0.0, 5.0, 90.0]]))
    write_transforms(folder, capture)
    turn = math.radians(heading)
    for k, name in enumerate(capture.names):
        east = along[k] * math.sin(turn) + across[k] * math.cos(turn) + noise * draw.normal()
        north = along[k] * math.cos(turn) - across[k] * math.sin(turn) + noise * draw.normal()
        shrunk = METRES_PER_DEGREE * math.cos(math.radians(position.latitude))
        here = Position(
            position.latitude + north / METRES_PER_DEGREE,
            (position.longitude + east / shrunk + 540) % 360 - 180,
        )
        geotag(folder / "images" / name, block(here))


def azimuth_of_z(scene: ParsedScene) -> float:
    """Degrees clockwise from north to the z axis."""
    assert scene.north is not None
    up, _ = world_axes(scene.cameras)
    north = torch.tensor(scene.north.direction)
    right = torch.linalg.cross(north, up)
    return math.degrees(math.atan2(float(right[2]), float(north[2])))


@pytest.mark.parametrize("position", [LUND, CAPE, Position(40.0, -179.9999)])
@pytest.mark.parametrize("heading", [0.0, 90.0, -135.0])
def test_geotagged_photographs_tell_north(tmp_path: Path, position: Position, heading: float) -> None:
    walked(tmp_path, position, heading, noise=0.3)
    scene = parse_scene(tmp_path, 1, None)
    assert scene.north is not None and scene.north.southern == (position.latitude < 0)
    assert abs((azimuth_of_z(scene) - heading + 180) % 360 - 180) < 1.5
    assert "GPS" in scene.north.source and any("north" in note for note in scene.notes)
    assert str(round(position.latitude)) not in " ".join(scene.notes), "no place on the earth is told"


def test_a_scene_without_positions_or_with_too_few_says_no_north(tmp_path: Path) -> None:
    write_transforms(tmp_path / "bare", Capture.make(9))
    assert parse_scene(tmp_path / "bare", 1, None).north is None
    assert not parse_scene(tmp_path / "bare", 1, None).notes
    walked(tmp_path / "short", LUND, 0.0, length=3.0, noise=3.0)
    scene = parse_scene(tmp_path / "short", 1, None)
    assert scene.north is None and any("north: not known" in note for note in scene.notes)


def test_positions_that_are_all_one_contradict_no_other() -> None:
    places = torch.eye(3).repeat(4, 1)
    said = north_of(places, [LUND] * 12, torch.tensor([0.0, 0.0, 1.0]))
    assert isinstance(said, str) and "over 0 m" in said and "contradict" not in said


def test_a_reconstruction_of_odm_says_north_where_it_has_a_reference(tmp_path: Path) -> None:
    file = write_odm(tmp_path, Capture.make(9))
    assert parse_scene(tmp_path, 1, None).north is None
    text = file.read_text()
    for latitude, southern in ((30.2, False), (-12.0, True), (0.0, None)):
        reference = f'[{{"reference_lla": {{"latitude": {latitude}, "longitude": 0, "altitude": 0}}, '
        file.write_text(text.replace("[{", reference, 1))
        north = parse_scene(tmp_path, 1, None).north
        assert (north is None) == (southern is None)
        if north is not None:
            assert north.direction == (0, 1, 0) and north.southern == southern
    write_odm(tmp_path / "report", Capture.make(9), report=True)
    north = parse_scene(tmp_path / "report", 1, None).north
    assert north is not None and north.direction == (0, 1, 0) and north.southern is None
