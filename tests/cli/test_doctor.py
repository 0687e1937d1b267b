"""`fprf doctor`: methods and caches, its test of a device, and what it finds in scene folders."""

import json
import shutil
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from fake_packages import Packages
from PIL import Image
from pretend_cuda import CUDA, pretend_cuda
from raw_files import dng
from tiny_world import World

from fprf.cli import main as cli
from fprf.cli.doctor import (
    Finding,
    machine,
    method_needs,
    run,
    scene_folder,
    self_test,
    video_file,
    without_paths,
)
from fprf.errors import ConfigError, DataError
from fprf.ops import dense
from fprf.style.look import Restyle
from fprf.training import device_check, views
from fprf.training.device_check import compare


def _by_name(findings: Iterator[Finding]) -> dict[str, Finding]:
    return {finding.what: finding for finding in findings}


def test_scene_folders(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    found = _by_name(scene_folder(world.town))
    assert (
        found["format"].found == "transforms" and found["views"].found == "10 of 32 x 24 pixels, pinhole lens"
    )
    assert found["next"].found == f"fprf train --data {world.town}"
    assert run([str(world.town)]) == 0 and "32 x 24" in capsys.readouterr().out


METHOD = """
from dataclasses import replace
from fprf.methods import fprf
from fprf.plugins.encoders.config import DinoConfig
def m():
    return replace(fprf(), semantic=replace(fprf().semantic, encoder=DinoConfig()))
"""
"""A method with an encoder of the hub."""


def test_a_method_says_what_it_needs(
    packages: Packages, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert run(["fprf-lite"]) == run(["fprf"]) == 0, "what they need ships"
    packages.install("acme-m", {"fprf.methods": {"acme-m": "acme_methods:m"}}, code={"acme_methods": METHOD})
    assert run(["acme-m"]) == 1
    package, model = (finding for finding in method_needs("acme-m") if finding.what == "needs")
    assert (
        "transformers" in package.found and package.remedy.startswith("pip install") and not package.optional
    )
    assert model.remedy == "hf download facebook/dino-vits8" and model.optional, (
        "it is downloaded where there is a network"
    )
    snapshot = tmp_path / "models--facebook--dino-vits8" / "snapshots" / "1"
    snapshot.mkdir(parents=True)
    (snapshot / "config.json").touch()
    assert [finding for finding in method_needs("acme-m") if finding.what == "needs"] == [package]


def test_the_feature_cache_is_told_and_cleaned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = tmp_path / "fprf" / "features" / "content"
    files.mkdir(parents=True)
    (files / "a.safetensors").write_bytes(bytes(3 << 20))
    (tmp_path / "fprf" / "weights").mkdir()
    assert _by_name(machine())["features"].found.startswith("3 MiB of at most 2048")
    assert run(["--clean"]) == 0 and "3 MiB deleted" in capsys.readouterr().out
    assert not files.exists() and (tmp_path / "fprf" / "weights").is_dir()


def test_a_cache_that_cannot_be_written_to_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    finding = _by_name(machine())["cache"]
    assert str(tmp_path / "file") in finding.found and "XDG_CACHE_HOME" in finding.remedy and finding.optional


def told(name: str) -> dict[str, Finding]:
    return {finding.what: finding for finding in self_test(name)}


def test_the_cpu_is_right_and_its_kernels_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--device", "cpu"]) == 0
    said = capsys.readouterr().out
    assert "numba's" in said and "training step, render, restyle as on the CPU" in said


def test_a_pretended_gpu_is_right_and_does_the_work() -> None:
    with pretend_cuda(memory=3 << 30) as seen:
        found = told("cuda:0")
    assert not any(finding.remedy for finding in found.values())
    assert seen.uploads and "3.0 GiB free" in found["device memory"].found
    assert "float32" in found["precision"].found and "torch" in found["kernels"].found


def off(function: Callable[..., Any], place: Callable[[Any], torch.Tensor]) -> Callable[..., Any]:
    """The function, wrong on the device alone."""

    def call(*args: Any, **kwargs: Any) -> Any:
        out = function(*args, **kwargs)
        return out * 1.01 if place(args).device == CUDA else out

    return call


@pytest.mark.parametrize("what", ["render", "restyle", "training step"])
def test_a_planted_fault_is_found(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if what == "restyle":
        monkeypatch.setattr(Restyle, "colour", off(Restyle.colour, lambda args: args[2]))
    elif what == "render":
        monkeypatch.setattr(views, "composite", off(views.composite, lambda args: args[1]))
    else:
        grad = torch.autograd.grad
        skewed = lambda *a, **k: [g * 1.01 if g.device == CUDA else g for g in grad(*a, **k)]  # noqa: E731
        monkeypatch.setattr(device_check.torch.autograd, "grad", skewed)
    with pretend_cuda():
        wrong = {each.what for each in compare(CUDA) if not each.right}
    assert what in wrong and "encoder" not in wrong


def test_a_wrong_kernel_of_the_cpu_is_found(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dense, "array", lambda x, real=dense.array: real(1.05 * x))
    assert cli.main(["doctor", "--device", "cpu"]) == 1
    said = [line for line in capsys.readouterr().out.splitlines() if "self-test" in line]
    assert len(said) == 1 and "differs from the CPU" in said[0] and "render is off by" in said[0]


def test_a_device_that_fails_or_is_absent_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = RuntimeError("CUDA error: no kernel image is available\nfor execution")
    monkeypatch.setattr(device_check, "render_view", Mock(side_effect=broken))
    assert "no kernel image" in told("cpu")["self-test"].found and told("cpu")["self-test"].remedy
    assert cli.main(["doctor", "--device", "cuda:7"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


VIEWS = 12


def write_scene(folder: Path, points: tuple[float, ...] = (0, 0, 0)) -> Path:
    """Views in a row before a wall of coloured points, as transforms.json with points.npz and with pictures
    of a texture.
    """
    draw = np.random.default_rng(0)
    texture = cv2.resize(
        draw.integers(40, 216, (48, 160, 3), dtype=np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC
    )
    frames = []
    (folder / "images").mkdir(parents=True)
    for k in range(VIEWS):
        pose = np.eye(4)
        pose[:3, 3] = [0.1 * k, 0, 0]
        frames.append({"file_path": f"images/{k:02d}.png", "transform_matrix": pose.tolist()})
        Image.fromarray(texture[:, 8 * k : 8 * k + 96]).save(folder / f"images/{k:02d}.png")
    wall = draw.uniform((-1, -1, -2.001), (2, 1, -2), (400, 3)) + np.array(points)
    np.savez(folder / "points.npz", xyz=wall)
    content = {"w": 96, "h": 96, "fl_x": 160.0, "fl_y": 160.0, "cx": 48.0, "cy": 48.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_a_scene_without_faults_has_none(tmp_path: Path) -> None:
    found = _by_name(scene_folder(write_scene(tmp_path / "s")))
    assert set(found) == {"format", "views", "split", "north", "points", "next"}
    assert not any(finding.remedy for finding in found.values())
    assert found["points"].found.startswith("400 ") and "10 of 10" in found["points"].found


def test_what_was_left_out_is_told(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s")
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][3]["fl_x"] = np.nan
    (folder / "transforms.json").write_text(json.dumps(content))
    found = _by_name(scene_folder(folder))
    assert "1 of 12" in found["note"].found and found["views"].found.startswith("11 ")


def test_points_that_no_view_sees_are_told(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s", points=(0, 0, 50))
    assert (
        "0 of 10" in _by_name(scene_folder(folder))["points"].found
        and _by_name(scene_folder(folder))["points"].optional
    )
    (folder / "points.npz").unlink()
    assert _by_name(scene_folder(folder))["points"].found.startswith("none")


@pytest.mark.parametrize("value", [0, 255, 128])
def test_masks_that_say_nothing_are_told(tmp_path: Path, value: int) -> None:
    folder = write_scene(tmp_path / "s")
    (folder / "masks").mkdir()
    for k in range(VIEWS):
        mask = np.full((96, 96), value if value != 128 else 0, np.uint8)
        mask[:48] = 255 if value == 128 else value
        Image.fromarray(mask).save(folder / f"masks/{k:02d}.png")
    mask = _by_name(scene_folder(folder)).get("masks")
    assert mask is None if value == 128 else mask is not None and mask.optional == (value == 255)


def test_damaged_images_are_named(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s")
    data = (folder / "images/06.png").read_bytes()
    (folder / "images/06.png").write_bytes(data[: len(data) // 2])
    assert (
        "06.png" in _by_name(scene_folder(folder))["images"].found
        and not _by_name(scene_folder(folder))["images"].optional
    )


def test_transparent_hdr_and_raw_photographs_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_scene(tmp_path / "s")
    pictures = folder / "images"
    clear = np.dstack(
        [np.asarray(Image.open(pictures / "03.png").convert("RGB")), np.zeros((96, 96), np.uint8)]
    )
    Image.fromarray(clear).save(pictures / "03.png")
    data = (pictures / "05.png").read_bytes()
    tag = b"cICP" + bytes((9, 16, 0, 1))
    chunk = struct.pack(">I", 4) + tag + struct.pack(">I", zlib.crc32(tag))
    (pictures / "05.png").write_bytes(data[:33] + chunk + data[33:])
    found = _by_name(scene_folder(folder))
    assert "03.png: 0.00% of its pixels are opaque" in found["images"].found and found["images"].remedy
    assert "05.png" in found["colours"].found and "PQ" in found["colours"].found
    flat = np.full((96, 96, 3), 0.5)
    (pictures / "05.png").write_bytes(dng(flat, np.zeros((8, 8, 3), np.uint8)))
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "rawpy", None)
        with pytest.raises(DataError, match=r"05\.png: is a raw photograph \(DNG\).*fprf\[raw\]"):
            list(scene_folder(folder))
    pytest.importorskip("rawpy")
    assert "raw (DNG)" in _by_name(scene_folder(folder))["colours"].found


def save_picture(path: Path, grey: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((12, 16, 3), grey, np.uint8)).save(path)


def test_what_will_be_left_out_of_photographs_is_named(tmp_path: Path) -> None:
    for k in range(4):
        for name in (f"{k}.png", f"{k} (1).png", f"Thumbs/{k}.png"):
            save_picture(tmp_path / name, 40 * k)
    save_picture(tmp_path / "masks" / "0.png", 0)
    found = [finding.found for finding in scene_folder(tmp_path) if finding.what in ("note", "images")]
    assert found[0].startswith("4 ")
    assert sorted(line.split(": ")[1].split(" ")[0] for line in found[1:]) == ["1", "4", "4"]
    assert any("Thumbs/0.png" in line for line in found) and any("0 (1).png" in line for line in found)


def test_what_a_scene_leaves_out_scales_and_lacks_is_named(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    content = json.loads((scene / "transforms.json").read_text())
    first = content["frames"][0]
    original = scene / first["file_path"]
    shutil.copy(original, original.with_name("copy of it.png"))
    content["frames"].append({**first, "file_path": f"{original.parent.name}/copy of it.png"})
    (scene / "transforms.json").write_text(json.dumps(content))
    (scene / "points.npz").unlink()
    save_picture(scene / "masks" / "who.png", 0)
    found = list(scene_folder(scene))
    assert any("copy of it.png" in finding.found for finding in found if finding.what == "note")
    (masks,) = (finding for finding in found if finding.what == "masks")
    assert "who.png" in masks.found and masks.remedy and not masks.optional


def test_a_video_says_what_can_be_read_of_it(tmp_path: Path) -> None:
    from fprf.io.video import write_video

    frames = [np.random.default_rng(k).integers(0, 255, (48, 64, 3), dtype=np.uint8) for k in range(9)]
    write_video(tmp_path / "clip.mp4", frames, 9, h264=False)
    found = _by_name(video_file(tmp_path / "clip.mp4"))
    assert found["format"].found == "video of 64 x 48 pixels"
    assert "9 frames" in found["frames"].found and not found["frames"].remedy
    assert found["next"].found == f"fprf process {tmp_path / 'clip.mp4'}"
    assert run([str(tmp_path / "clip.mp4")]) == 0
    (tmp_path / "half.mp4").write_bytes((tmp_path / "clip.mp4").read_bytes()[:2000])
    with pytest.raises(DataError, match="moov"):
        run([str(tmp_path / "half.mp4")])


def test_photographs_that_say_no_focal_length_are_told(tmp_path: Path) -> None:
    for name in ("anna", "ben"):
        for k in range(4):
            pixels = np.random.default_rng(len(name) + 9 * k).integers(0, 255, (16, 24, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(tmp_path / f"{name}_{k}.jpg")
    found = _by_name(scene_folder(tmp_path))["lenses"].found
    assert found.startswith("8 of 8 photographs") and "names" in found


def test_cuda_without_a_card_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", "12.6")
    monkeypatch.setattr(torch.version, "hip", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    (told,) = (each for each in machine() if "no NVIDIA GPU is here" in each.found)
    assert told.optional and told.remedy.endswith("/whl/cpu")


def test_a_report_names_no_place_and_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a cache of mine"))
    monkeypatch.setattr("getpass.getuser", lambda: "margaret")
    monkeypatch.setattr("platform.node", lambda: "attic-pc")
    monkeypatch.setattr(
        "fprf.cli.doctor.self_test", lambda device: iter([Finding("self-test", "margaret on attic-pc")])
    )
    assert run(["--report"]) == 0
    text = capsys.readouterr().out
    assert "torch" in text and "NAME on NAME" in text
    for private in ("margaret", "attic", str(tmp_path), tmp_path.name, "of mine"):
        assert private not in text
    assert run(["--report", "--device", "cpu"]) == 0
    with pytest.raises(ConfigError, match="report"):
        run(["--report", "fprf-lite"])


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("3 MiB in /home/ann/.cache/fprf/features; --clean", "3 MiB in PATH; --clean"),
        (r"C:\\Users\\Ann\\x.ply: cut off", "PATH"),
        ("PSNR 1/2, https://pypi.org and 30 MiB/s stay", "PSNR 1/2, https://pypi.org and 30 MiB/s stay"),
        ("~/x is one", "PATH is one"),
    ],
)
def test_paths_are_left_out(text: str, left: str) -> None:
    assert without_paths(text).startswith(left)
