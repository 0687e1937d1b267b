"""Captures in the format of Mission Bay: TFRecord files, cameras behind rays; read, refused, and trained."""

import errno
import struct
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from capture_files import Capture, cameras_of
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers import blocknerf
from fprf.datamanagers.parsers.blocknerf import crc32c, fit_camera, masked, read_examples, read_records
from fprf.datamanagers.parsers.config import BlockNerfConfig, parse_scene, recognise
from fprf.errors import ConfigError, DataError, WriteError
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through


def varint(value: int) -> bytes:
    value &= 0xFFFFFFFFFFFFFFFF
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def chunk(number: int, data: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(data)) + data


def example(values: dict[str, Any], packed: bool = True) -> bytes:
    """A serialised Example; lists of integers, arrays of floats, bytes."""
    entries = b""
    for name, value in values.items():
        if isinstance(value, bytes):
            body = chunk(1, chunk(1, value))
        elif isinstance(value, list):
            whole = [varint(v) for v in value]
            body = chunk(
                3, chunk(1, b"".join(whole)) if packed else b"".join(varint(1 << 3) + w for w in whole)
            )
        else:
            raw = value.astype("<f4").tobytes()
            parts = [varint(1 << 3 | 5) + raw[k : k + 4] for k in range(0, len(raw), 4)]
            body = chunk(2, chunk(1, raw) if packed else b"".join(parts))
        entries += chunk(1, chunk(1, name.encode()) + chunk(2, body))
    return chunk(1, entries)


def features(
    image: np.ndarray, origin: np.ndarray, direction: np.ndarray, **more: object
) -> dict[str, object]:
    """Those of an image [H W 3] and its rays [H W 3]."""
    done, png = cv2.imencode(".png", image)
    assert done
    given: dict[str, object] = {
        "image": png.tobytes(),
        "image_hash": [99],
        "cam_idx": [5],
        "height": [image.shape[0]],
        "width": [image.shape[1]],
        "equivalent_exposure": np.array([1.0], np.float32),
        "ray_origins": np.float32(origin).reshape(-1),
        "ray_dirs": np.float32(direction).reshape(-1),
    }
    return given | more


def record(data: bytes) -> bytes:
    head = struct.pack("<Q", len(data))
    return head + struct.pack("<I", masked(crc32c(head))) + data + struct.pack("<I", masked(crc32c(data)))


def bay_records(folder: Path, views: int = 16) -> Cameras:
    """Two cameras of different focal length and exposure in turn, in three files; every fourth record is for
    validation.
    """
    size = (32, 24)
    cameras = cameras_of(
        torch.from_numpy(Capture.make(views).poses),
        size,
        [[30.0 if k % 2 else 24.0] * 2 for k in range(views)],
        (16.7, 11.6),
        (-0.05, 0.01, 0.0, 0.0, 0.001, -0.001),
    )
    held = []
    learned = []
    for k in range(views):
        rays = rays_through(cameras, torch.full((size[0] * size[1],), k), pixel_grid(cameras, k))
        exposure = np.array([0.5 if k % 2 else 1.0], np.float32)
        more = {"image_hash": [-(k + 1) * 7919], "cam_idx": [k % 2], "equivalent_exposure": exposure}
        whole = example(
            features(np.full((size[1], size[0], 3), k, np.uint8), *(ray.numpy() for ray in rays), **more)
        )
        (held if k % 4 == 3 else learned).append(record(whole))
    folder.mkdir(parents=True, exist_ok=True)
    half = len(learned) // 2
    (folder / "bay_train.tfrecord-00000-of-00002").write_bytes(b"".join(learned[:half]))
    (folder / "bay_train.tfrecord-00001-of-00002").write_bytes(b"".join(learned[half:]))
    (folder / "bay_validation.tfrecord-00000-of-00001").write_bytes(b"".join(held))
    return cameras


def test_the_checksum_is_castagnoli_s() -> None:
    assert crc32c(b"123456789") == 0xE3069283, "the check value of CRC-32C"
    assert crc32c(bytes(32)) == 0x8A9136AA, "RFC 3720, B.4"
    assert crc32c(b"") == 0


names = st.text(min_size=1, max_size=8)
values = st.one_of(
    st.binary(max_size=40),
    st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=5),
    st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1, max_size=5).map(
        lambda v: np.array(v, np.float32)
    ),
)


@given(st.lists(st.dictionaries(names, values, max_size=4), max_size=3), st.booleans())
def test_what_was_written_is_read(tmp_path_factory, written, packed: bool) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path_factory.mktemp("records") / "a.tfrecord"
    path.write_bytes(b"".join(record(example(values, packed)) for values in written))
    found = list(read_examples(path))
    assert len(found) == len(written)
    for one, wanted in zip(found, written, strict=True):
        assert one.features.keys() == wanted.keys()
        for name, value in wanted.items():
            if isinstance(value, bytes):
                assert one.blob(name) == value
            elif isinstance(value, list):
                assert list(one.features[name][1]) == value
            else:
                assert one.numbers(name, len(value)).tobytes() == value.tobytes()


@given(st.data())
def test_a_flipped_bit_and_a_lost_end_are_found_wherever_they_are(
    tmp_path_factory, data: st.DataObject
) -> None:  # type: ignore[no-untyped-def]
    whole = bytearray(record(b"some bytes") + record(b"more"))
    at = data.draw(st.integers(0, 8 * len(whole) - 1))
    whole[at // 8] ^= 1 << at % 8
    path = tmp_path_factory.mktemp("flipped") / "a.tfrecord"
    first = len(record(b"some bytes"))
    for damaged in (whole, record(b"some bytes")[: data.draw(st.integers(1, first - 1))]):
        path.write_bytes(bytes(damaged))
        with pytest.raises(DataError, match=r"record [01]: .*; (download|split)"):
            list(read_records(path))


number = st.floats(-1, 1)


def rays_of(camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    width, height = camera.size[0].tolist()
    origin, direction = rays_through(
        camera, torch.zeros(width * height, dtype=torch.int64), pixel_grid(camera, 0)
    )
    return (x.float().numpy().reshape(height, width, 3) for x in (origin, direction))  # type: ignore[return-value]


@settings(max_examples=25)
@given(number, number, number, number, number)
def test_a_bent_camera_is_found_again(x: float, y: float, z: float, k1: float, p1: float) -> None:
    pose = np.concatenate([cv2.Rodrigues(3 * np.array([x, y, z]))[0], [[100.0], [-20.0], [3.0]]], 1)
    k = (0.1 * k1, -0.02 * k1, 0.0, 0.0, 0.002 * p1, 0.001)
    truth = cameras_of(torch.from_numpy(pose)[None], (64, 48), (40.0, 42.0), (31.0, 25.5), k)
    found = fit_camera(*rays_of(truth))
    assert found.error < 2e-3
    np.testing.assert_allclose(found.pose, truth.pose[0].numpy(), atol=3e-4)
    np.testing.assert_allclose(found.focal, (40.0, 42.0), rtol=3e-4)
    np.testing.assert_allclose(found.centre, (31.0, 25.5), atol=2e-2)
    np.testing.assert_allclose(found.distortion, truth.distortion[0].numpy(), atol=2e-3)


@pytest.fixture(scope="module")
def bay(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Cameras]:
    folder = tmp_path_factory.mktemp("bay")
    cameras = bay_records(folder / "data")
    (folder / "data/._a.tfrecord").write_bytes(b"\0\5\x16\7Mac OS X")
    return folder / "data", cameras


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_the_scene_is_what_was_written(bay: tuple[Path, Cameras]) -> None:
    folder, truth = bay
    assert recognise(folder) == BlockNerfConfig()
    scene = parse_scene(folder, 1, None)
    assert len(scene.paths) == 16 and len(scene.train) == 12 and len(scene.test) == 4
    assert scene.exposure is not None
    # Names: camera by camera, in the order of the hashes.
    number = [(2**64 - int(path.stem.split("-")[1], 16)) // 7919 - 1 for path in scene.paths]
    assert sorted(number) == list(range(16))
    for view, k in enumerate(number):
        assert scene.paths[view].stem.startswith(f"cam{k % 2:02d}-")
        assert float(scene.exposure[view]) == (0.5 if k % 2 else 1.0)
        assert (view in scene.test.tolist()) == (k % 4 == 3)
        grid = pixel_grid(truth, k)
        mine, own = (
            rays_through(cameras, torch.full((len(grid),), at), grid)
            for cameras, at in ((scene.cameras, view), (truth, k))
        )
        torch.testing.assert_close(mine[0], own[0], atol=1e-4, rtol=0)
        torch.testing.assert_close(mine[1], own[1], atol=2e-4, rtol=0)
        assert load_image(scene.paths[view]).shape == (24, 32, 3)


def test_a_complete_cache_is_not_read_again(
    bay: tuple[Path, Cameras], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = parse_scene(bay[0], 1, None)
    with monkeypatch.context() as patch:
        patch.setattr(blocknerf, "read_examples", lambda path: pytest.fail("read again"))
        again = parse_scene(bay[0], 2, None)
    assert again.paths == first.paths and again.cameras.size[0].tolist() == [16, 12]
    first.paths[3].unlink()
    assert parse_scene(bay[0], 1, None).paths[3].is_file()


def test_without_a_cache_or_with_a_disk_that_fills_the_scene_is_the_same(
    bay: tuple[Path, Cameras], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = parse_scene(bay[0], 1, None)
    (tmp_path / "file").touch()
    (tmp_path / "small").mkdir()
    written = []
    real = blocknerf.atomic_path

    def filling(path: Path) -> AbstractContextManager[Path]:
        written.append(path)
        if len(written) > 5 and path.is_relative_to(tmp_path / "small"):
            raise WriteError("full") from OSError(errno.ENOSPC, "full")
        return real(path)

    monkeypatch.setattr(blocknerf, "atomic_path", filling)
    for place in ("file", "small"):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / place))
        scene = parse_scene(bay[0], 1, None)
        assert torch.equal(scene.cameras.pose, expected.cameras.pose)
        for mine, own in zip(scene.paths, expected.paths, strict=True):
            assert mine.read_bytes() == own.read_bytes() and not mine.is_relative_to(tmp_path)
    assert not [path for path in (tmp_path / "small").rglob("*") if path.is_file()], "half of it is dropped"


def test_some_cameras(bay: tuple[Path, Cameras]) -> None:
    scene = parse_scene(bay[0], 1, BlockNerfConfig(cameras=(1,)))
    assert len(scene.paths) == 8 and all(path.stem.startswith("cam01") for path in scene.paths)
    with pytest.raises(DataError, match=r"no images of cameras \[7\]; parser.cameras may name \[0, 1\]"):
        parse_scene(bay[0], 1, BlockNerfConfig(cameras=(7,)))
    with pytest.raises(ConfigError, match=r"parser.cameras"):
        BlockNerfConfig(cameras=(-1,))


X, Y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
RAYS = np.stack([(X - 16) / 30, -(Y - 12) / 30, -np.ones_like(X)], -1)
GREY = np.full((24, 32, 3), 90, np.uint8)
ORIGIN = np.zeros((24, 32, 3))


def test_rays_of_no_camera_are_refused_unless_told(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    bay_records(folder, views=4)
    rays = RAYS + np.random.default_rng(0).normal(0, 0.1, RAYS.shape)
    (folder / "odd_train.tfrecord").write_bytes(record(example(features(GREY, ORIGIN, rays))))
    with pytest.raises(
        DataError, match=r"the rays of cam05-0000000000000063 are .* pixels .*parser.tolerance is 1"
    ):
        parse_scene(folder, 1, None)
    assert len(parse_scene(folder, 1, BlockNerfConfig(tolerance=50)).paths) == 5


@pytest.mark.parametrize(
    "change, said",
    [
        ({"height": [25]}, "ray_origins holds 2304 floats, needed: 2400 floats"),
        ({"height": [2]}, "an image of 32x2 pixels"),
        ({"ray_dirs": np.zeros(24 * 32 * 3, np.float32)}, "its rays are not those of a camera"),
        ({"equivalent_exposure": np.array([0.0], np.float32)}, "equivalent_exposure is 0.0"),
        ({"image": [1]}, "image holds 1 integers, needed: 1 byte strings"),
        ({"cam_idx": b"x"}, "cam_idx holds 1 byte strings, needed: 1 integers"),
    ],
)
def test_records_that_cannot_be_are_named(tmp_path: Path, change: dict[str, object], said: str) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "a_train.tfrecord").write_bytes(record(example(features(GREY, ORIGIN, RAYS) | change)))
    with pytest.raises(DataError, match=said) as caught:
        parse_scene(folder, 1, None)
    assert "a_train.tfrecord: record 0" in str(caught.value)
