"""Raw photographs: told from ordinary files by their content, and developed."""

import io
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from raw_files import dng, linear, thumbnail, tiff

from fprf.datamanagers.image_files import colour_note, kind_of, raw_kind_of, read_header
from fprf.datamanagers.images import image_names, load_cutout, load_image, photographs, raw_twins
from fprf.errors import DataError

SMALL = np.full((12, 16, 3), (0, 0, 0), np.uint8)
GREEN = np.full((40, 60, 3), (20, 160, 60), np.uint8)


def quarters() -> np.ndarray:
    pixels = np.empty((96, 128, 3))
    pixels[:48, :64], pixels[:48, 64:] = (0.8, 0.2, 0.2), (0.2, 0.7, 0.3)
    pixels[48:, :64], pixels[48:, 64:] = (0.2, 0.3, 0.8), (0.8, 0.75, 0.2)
    return pixels


def jpeg() -> bytes:
    out = io.BytesIO()
    Image.fromarray(GREEN).save(out, "JPEG", quality=95)
    return out.getvalue()


RAW = {
    "dng": dng(quarters(), SMALL),
    "nef": dng(quarters(), SMALL, version=False),
    "big endian": tiff(
        thumbnail(SMALL) | {330: (4, ["inside"])}, {262: (3, [34892])}, [SMALL.tobytes()], order=">"
    ),
    "no thumbnail": tiff({254: (4, [0]), 262: (3, [32803])}, None, []),
    "compression of a maker": tiff(
        thumbnail(SMALL) | {330: (4, ["inside"])}, {259: (3, [34713])}, [SMALL.tobytes()]
    ),
    "cr2": b"II*\0\x10\0\0\0CR\x02\0" + bytes(80),
    "cr3": struct.pack(">I", 24) + b"ftypcrx \0\0\0\1crx isom" + bytes(80),
    "rw2": b"IIU\0\x18\0\0\0" + bytes(80),
    "orf": b"IIRO\x08\0\0\0" + bytes(80),
    "orf, motorola": b"MMOR\0\0\0\x08" + bytes(80),
    "raf": b"FUJIFILMCCD-RAW 0201" + bytes(80),
    "x3f": b"FOVb" + bytes(80),
    "crw": b"II\x1a\0\0\0HEAPCCDR" + bytes(80),
    "mrw": b"\0MRM" + bytes(80),
    "iiq": b"II*\0IIII" + bytes(80),
}
full = thumbnail(GREEN, reduced=False)
ORDINARY = {
    "jpeg": jpeg(),
    "tiff": tiff(full, None, [GREEN.tobytes()]),
    "tiff of an exporter that kept DNGVersion": tiff(
        full | {50706: (1, [1, 4, 0, 0])}, None, [GREEN.tobytes()]
    ),
    "tiff flagged as reduced": tiff(thumbnail(GREEN), None, [GREEN.tobytes()]),
    "tiff with a reduced copy inside": tiff(
        full | {330: (4, ["inside"])},
        thumbnail(SMALL) | {273: (4, ["strip 1"])},
        [GREEN.tobytes(), SMALL.tobytes()],
    ),
    "tiff that begins with its thumbnail": tiff(
        thumbnail(SMALL) | {330: (4, ["inside"])},
        full | {273: (4, ["strip 1"])},
        [SMALL.tobytes(), GREEN.tobytes()],
    ),
    "the same, big endian": tiff(
        thumbnail(SMALL) | {330: (4, ["inside"])},
        full | {273: (4, ["strip 1"])},
        [SMALL.tobytes(), GREEN.tobytes()],
        order=">",
    ),
}


@pytest.mark.parametrize("name", RAW)
@pytest.mark.parametrize("suffix", [".dng", ".tif", ".jpg"])
def test_raw_files_are_told_by_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, suffix: str
) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(RAW[name])
    for read in (load_image, read_header, load_cutout):
        with pytest.raises(DataError, match=r"a raw photograph.*rawpy.*pip install 'fprf\[raw\]'.*JPEG"):
            read(path)
    assert kind_of(RAW[name][:64])


@pytest.mark.parametrize("name", ORDINARY)
def test_ordinary_files_are_read_whatever_their_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.dng"
    path.write_bytes(ORDINARY[name])
    with path.open("rb") as file:
        assert raw_kind_of(file, path) == ""
    assert np.abs(load_image(path).astype(int) - GREEN).max() <= 3
    assert read_header(path)[:2] == (60, 40)


@pytest.mark.parametrize("neutral", [(1.0, 1.0, 1.0), (0.5, 1.0, 0.7)])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_dng_is_developed_upright_with_the_camera_s_white(
    tmp_path: Path, neutral: tuple[float, float, float], orientation: int
) -> None:
    pytest.importorskip("rawpy")
    path = tmp_path / "a.jpg"
    path.write_bytes(dng(quarters(), SMALL, neutral=neutral, orientation=orientation))
    wanted = np.rot90(quarters(), {1: 0, 3: 2, 6: 3, 8: 1}[orientation])
    found = load_image(path)
    assert found.shape == wanted.shape
    assert read_header(path) == (wanted.shape[1], wanted.shape[0], False, "raw")
    assert np.array_equal(found, load_image(path, upright=True)), "upright everywhere"
    # The edges between colours are the demosaicing's.
    inner = np.abs(found / 255 - wanted)
    for rows in (slice(8, 40 if wanted.shape[0] == 96 else 56), slice(-40, -8)):
        assert inner[rows, 8:40].max() < 0.012 and inner[rows, -40:-8].max() < 0.012
    assert "DNG" in colour_note(path)


def test_a_scene_keeps_one_exposure(tmp_path: Path) -> None:
    """Darker photographs stay darker."""
    pytest.importorskip("rawpy")
    for name, gain in (("a.dng", 1.0), ("b.dng", 0.25)):
        flat = np.full((64, 64, 3), 0.8)
        scaled = np.where(
            linear(flat) * gain <= 0.0031308, 0, 1.055 * (linear(flat) * gain) ** (1 / 2.4) - 0.055
        )
        (tmp_path / name).write_bytes(dng(scaled, SMALL))
        assert np.abs(load_image(tmp_path / name) / 255 - scaled).max() < 0.01


def test_a_damaged_raw_file_is_refused_with_the_reason(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    for name in ("cr2", "raf", "cr3", "no thumbnail"):
        (tmp_path / "a.raw").write_bytes(RAW[name])
        with pytest.raises(
            DataError, match=r"a raw photograph .* that rawpy cannot read: .*export it as JPEG"
        ):
            load_image(tmp_path / "a.raw")


def test_raw_beside_a_jpeg_of_the_same_name_is_the_same_photograph(tmp_path: Path) -> None:
    for name in ("A1.JPG", "a2.jpg"):
        (tmp_path / name).write_bytes(jpeg())
    for name in ("A1.DNG", "a3.dng"):
        (tmp_path / name).write_bytes(RAW["dng"])
    assert image_names(tmp_path) == ["A1.JPG", "a2.jpg", "a3.dng"]
    assert raw_twins([tmp_path / "A1.DNG", tmp_path / "A1.JPG", tmp_path / "b" / "A1.dng"]) == [
        tmp_path / "A1.DNG"
    ]


def test_a_folder_of_references_leaves_out_what_cannot_be_developed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "a.jpg").write_bytes(jpeg())
    (tmp_path / "b.nef").write_bytes(RAW["nef"])
    told = list[str]()
    assert photographs([tmp_path], told.append) == [tmp_path / "a.jpg"]
    assert len(told) == 1 and "b.nef" in told[0] and "fprf[raw]" in told[0]
