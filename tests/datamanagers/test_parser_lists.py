"""Mega-NeRF's layout and Photo Tourism's lists, on files that are written here."""

from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import Capture, write_colmap, write_image

from fprf.datamanagers.parsers.config import ColmapConfig, MegaNerfConfig, PhotoTourismConfig, parse_scene, recognise
from fprf.errors import DataError


def write_meganerf(folder: Path, capture: Capture, held: tuple[int, ...] = (2, 5), unit: float | None = 50.0) -> None:
    for k, name in enumerate(capture.names):
        part = folder / ("val" if k in held else "train")
        (part / "metadata").mkdir(parents=True, exist_ok=True)
        write_image(part / "rgbs" / name, capture.size, seed=k)
        fx, fy = capture.focal
        metadata = {
            "W": capture.size[0],
            "H": capture.size[1],
            "c2w": torch.from_numpy(capture.poses[k]).float(),
            "intrinsics": torch.tensor([fx, fy, 12.0, 8.0]),
            "distortion": torch.zeros(4),
        }
        torch.save(metadata, part / "metadata" / Path(name).with_suffix(".pt").name)
    if unit is not None:
        torch.save({"origin_drb": torch.zeros(3), "pose_scale_factor": unit}, folder / "coordinates.pt")


@pytest.mark.parametrize("unit", [None, 50.0])
def test_a_meganerf_folder_is_the_capture(tmp_path: Path, unit: float | None) -> None:
    capture = Capture.make(focal=(20.0, 21.0))
    write_meganerf(tmp_path, capture, unit=unit)
    assert recognise(tmp_path) == MegaNerfConfig()
    scene = parse_scene(tmp_path, 1, None)
    assert scene.test.tolist() == [2, 5] and len(scene.train) == 8
    assert np.allclose(scene.cameras.pose[:, :, :3].numpy(), capture.poses[:, :, :3], atol=1e-6)
    assert np.allclose(scene.cameras.pose[:, :, 3].numpy(), capture.poses[:, :, 3] * (unit or 1.0), atol=1e-5)
    assert scene.cameras.focal[3].tolist() == [20.0, 21.0] and scene.cameras.centre[3].tolist() == [12.0, 8.0]
    assert parse_scene(tmp_path, 2, None).cameras.size[0].tolist() == [12, 8]


def test_meganerf_files_that_are_missing(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no \*.pt files"):
        parse_scene(tmp_path, 1, MegaNerfConfig())
    write_meganerf(tmp_path, Capture.make(3))
    (tmp_path / "train/rgbs/0001.png").unlink()
    with pytest.raises(DataError, match=r"no image .*0001\.jpg"):
        parse_scene(tmp_path, 1, None)
    (tmp_path / "coordinates.pt").write_bytes(b"nonsense")
    with pytest.raises(DataError, match=r"coordinates.pt: no tensors"):
        parse_scene(tmp_path, 1, None)
    torch.save({"pose_scale_factor": -1.0}, tmp_path / "coordinates.pt")
    with pytest.raises(DataError, match="pose_scale_factor is -1"):
        parse_scene(tmp_path, 1, None)


def write_table(path: Path, rows: list[tuple[str, str, str]]) -> None:
    lines = ["filename\tid\tsplit\tdataset", *("\t".join((*row, "gate")) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("inner", ["", "dense"])
def test_the_table_says_who_is_in_and_for_what(tmp_path: Path, inner: str) -> None:
    capture = Capture.make(6)
    write_colmap(tmp_path / inner, capture)
    rows = [(name, str(k), "test" if k == 4 else "train") for k, name in enumerate(capture.names) if k != 2]
    rows += [("other.jpg", "9", "train"), (capture.names[2], "nan", "train")]
    write_table(tmp_path / "gate.tsv", rows)
    assert recognise(tmp_path) == PhotoTourismConfig()
    scene = parse_scene(tmp_path, 1, None)
    whole = ColmapConfig().build().parse(tmp_path / inner, 1)
    assert [path.name for path in scene.paths] == [name for k, name in enumerate(capture.names) if k != 2]
    assert (scene.train.tolist(), scene.test.tolist()) == ([0, 1, 2, 4], [3])
    kept = torch.tensor([0, 1, 3, 4, 5])
    assert torch.equal(scene.cameras.pose, whole.cameras.pose[kept])
    assert scene.seen is not None and whole.seen is not None
    for new, old in enumerate(kept.tolist()):
        mine = scene.seen[scene.seen[:, 0] == new][:, 1]
        assert torch.equal(mine, whole.seen[whole.seen[:, 0] == old][:, 1])
    assert int(scene.seen[:, 0].max()) <= 4


def test_tables_that_do_not_fit(tmp_path: Path) -> None:
    capture = Capture.make(3)
    write_colmap(tmp_path, capture)
    with pytest.raises(DataError, match=r"0 tables \*.tsv; exactly one"):
        parse_scene(tmp_path, 1, PhotoTourismConfig())
    with pytest.raises(DataError, match=r"gone.tsv: no such table"):
        parse_scene(tmp_path, 1, PhotoTourismConfig(list="gone.tsv"))
    write_table(tmp_path / "a.tsv", [("elsewhere.png", "1", "train")])
    with pytest.raises(DataError, match="none of its training photographs"):
        parse_scene(tmp_path, 1, None)
    write_table(tmp_path / "b.tsv", [(name, str(k), "train") for k, name in enumerate(capture.names)])
    assert len(parse_scene(tmp_path, 1, PhotoTourismConfig(list="b.tsv")).train) == 3


def test_an_image_on_both_sides_is_refused(tmp_path: Path) -> None:
    write_meganerf(tmp_path, Capture.make(3), held=())
    write_meganerf(tmp_path, Capture.make(3), held=(0, 1, 2))
    with pytest.raises(DataError, match=r"000\d is in train and in val"):
        parse_scene(tmp_path, 1, None)
