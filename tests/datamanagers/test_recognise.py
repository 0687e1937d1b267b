"""Which parser a folder gets, and the contract that parsers keep; real scenes in all their formats."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from capture_files import Capture, write_colmap, write_llff, write_transforms
from fake_packages import Packages

from fprf.datamanagers.parsers.config import (
    ColmapConfig,
    DataParserConfig,
    LlffConfig,
    Recognised,
    TransformsConfig,
    parse_scene,
    recognise,
)
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import DataError
from fprf.interfaces import DataParser
from fprf.rendering.cameras import project, rays_through
from fprf.testing import check_parser


def assert_same(one: ParsedScene, other: ParsedScene) -> None:
    """The same views, and rays through the same shares of their images, whose sizes may differ."""
    assert [path.stem for path in one.paths] == [path.stem for path in other.paths]
    assert torch.equal(one.train, other.train) and torch.equal(one.test, other.test)
    view = torch.arange(len(one.cameras)).repeat_interleave(4)
    share = torch.tensor([[0.1, 0.2], [0.9, 0.15], [0.5, 0.5], [0.3, 0.95]], dtype=torch.float64).repeat(
        len(one.cameras), 1
    )
    rays = [rays_through(scene.cameras, view, share * scene.cameras.size[view]) for scene in (one, other)]
    for a, b in zip(*rays, strict=True):
        assert (a - b).abs().max() <= 1e-12


def test_formats_are_told_by_their_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        recognise(tmp_path / "absent")
    for name in "abcdefg":
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"but 7 entries \(a, b, c, d, e, \.\.\.\)"):
        recognise(tmp_path)
    with pytest.raises(DataError, match="a file; give the scene folder"):
        recognise(tmp_path / "a")
    (tmp_path / "transforms_4.json").touch()
    assert recognise(tmp_path) == TransformsConfig()
    (tmp_path / "transforms_8.json").touch()
    with pytest.raises(DataError, match="but 9 entries"):
        recognise(tmp_path)
    for write, config in (
        (write_colmap, ColmapConfig()),
        (write_llff, LlffConfig()),
        (write_transforms, TransformsConfig()),
    ):
        write(tmp_path, Capture.make(2))  # type: ignore[operator]
        assert recognise(tmp_path) == config
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    assert recognise(tmp_path) == TransformsConfig()


def test_the_embedded_garden_is_read_by_name_where_no_such_folder_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = parse_scene(Path("garden"), 4, None)
    assert (
        scene.name == "garden"
        and len(scene.paths) == 25
        and len(scene.test) == 4
        and scene.points is not None
    )
    Path("garden").mkdir()
    for made in (".lock", "config.json"):  # --output garden
        Path("garden", made).touch()
        assert len(parse_scene(Path("garden"), 4, None).paths) == 25
    Path("garden/config.json").rename("garden/photograph.jpg")
    with pytest.raises(DataError, match="entries"):
        parse_scene(Path("garden"), 4, None)


PARSER = """
from dataclasses import dataclass
from fprf.datamanagers.parsers.config import DataParserConfig, Recognised

@dataclass(frozen=True, kw_only=True)
class ScanConfig(DataParserConfig):
    def recognises(self, data):
        return {answer}
"""


def test_a_strangers_parser_recognises_its_folders(packages: Packages, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    write_colmap(folder, Capture.make(2))
    for name, confidence in (("sure", 0.6), ("even", 0.5), ("faint", 0.2)):
        answer = f'Recognised({confidence}, "{name}.bin") if (data / "{name}.bin").is_file() else None'
        points = {"fprf.dataparsers": {name: f"acme_{name}:ScanConfig"}}
        packages.install(f"acme-{name}", points, code={f"acme_{name}": PARSER.format(answer=answer)})
    (folder / "faint.bin").touch()
    assert recognise(folder) == ColmapConfig()
    (folder / "even.bin").touch()
    with pytest.raises(
        DataError, match=r"by 'colmap' \(a model in .*\) and by 'even' \(even\.bin\); choose one with"
    ):
        recognise(folder)
    (folder / "sure.bin").touch()
    assert type(recognise(folder)).__module__ == "acme_sure"


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("1 / 0", "ZeroDivisionError"),
        ("raise SystemExit(3)", "SystemExit"),
        (PARSER.format(answer="[][0]"), "IndexError"),
        (PARSER.format(answer="exit(3)"), "SystemExit"),
        (PARSER.format(answer="True"), "TypeError"),
        (PARSER.format(answer='Recognised(2.0, "x")'), "ConfigError: confidence: 2.0 must lie in"),
        (PARSER.format(answer='Recognised(float("nan"), "x")'), "ConfigError"),
        ("from fprf.blocks.config import SingleConfig as ScanConfig", "not a DataParserConfig"),
    ],
)
def test_a_broken_parser_is_named_and_skipped(
    packages: Packages, tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str, told: str
) -> None:
    folder = tmp_path / "scene"
    write_colmap(folder, Capture.make(2))
    packages.install(
        "acme-bad", {"fprf.dataparsers": {"bad": "acme_bad4:ScanConfig"}}, code={"acme_bad4": source}
    )
    assert recognise(folder) == ColmapConfig()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: data parser 'bad' (acme_bad4:ScanConfig from acme-bad 1) is skipped: ")
    assert told in line
    (folder / "sparse").rename(folder / "elsewhere")
    with pytest.raises(DataError, match=r"for Gaussians --parser NAME \(bad, blocknerf"):
        recognise(folder)


SCENES = ["blender_lego", "drone_caliterra", "fox", "llff_fern", "llff_flower", "m360_bonsai", "street_lund"]


@pytest.mark.parametrize("name", SCENES)
def test_real_scenes(shared: Path, name: str) -> None:
    folder = shared / "data" / "scenes" / name
    scene = parse_scene(folder, 1, None)
    others: list[DataParserConfig] = [ColmapConfig()] if (folder / "sparse").exists() else []
    if (folder / "poses_bounds.npy").exists():
        others += [
            LlffConfig(images="images_8"),
            LlffConfig(images="images_4"),
            TransformsConfig(file="transforms_4.json"),
        ]
    for config in others:
        assert_same(scene, parse_scene(folder, 1, config))
    assert sorted(scene.train.tolist() + scene.test.tolist()) == list(range(len(scene.paths)))
    if scene.points is not None:
        view = torch.arange(len(scene.cameras))
        point = scene.points[:: max(1, len(scene.points) // 200)]
        pairs = torch.cartesian_prod(view, torch.arange(len(point)))
        pixel, depth = project(scene.cameras, pairs[:, 0], point[pairs[:, 1]])
        inside = ((pixel > 0) & (pixel < scene.cameras.size[pairs[:, 0]])).all(-1)
        # Each view sees some of the points, and nearly all that it sees lie within its bounds.
        assert torch.bincount(pairs[inside, 0], minlength=len(view)).min() > 0
        if scene.depths is not None:
            near, far = scene.depths[pairs[inside, 0]].unbind(-1)
            assert ((depth[inside] > 0.5 * near) & (depth[inside] < 2 * far)).double().mean() > 0.9


class Parser(DataParser):
    """The built-in one, with one thing wrong."""

    def __init__(self, wrong: str) -> None:
        self.wrong = wrong
        self.calls = 0

    def parse(self, data: Path, downscale: int) -> ParsedScene:
        self.calls += 1
        if self.wrong == "absent" and not data.exists():
            raise FileNotFoundError(data)
        scene = TransformsConfig().build().parse(data, 1 if self.wrong == "size" else downscale)
        cameras = scene.cameras
        pose = scene.cameras.pose
        changes: dict[str, dict[str, Any]] = {
            "mirrored": {"cameras": replace(cameras, pose=pose * torch.tensor([[-1.0, 1, 1, 1]]))},
            "scaled": {"cameras": replace(cameras, pose=2 * pose)},
            "float": {"cameras": replace(cameras, pose=pose.float())},
            "split": {"test": scene.train[:1]},
            "paths": {"paths": scene.paths[1:]},
            "order": {"paths": scene.paths[:: 1 if self.calls == 1 else -1]},
        }
        return replace(scene, **changes.get(self.wrong, {}))


@dataclass(frozen=True, kw_only=True)
class ParserConfig(DataParserConfig):
    wrong: str = ""

    def recognises(self, data: Path) -> Recognised | None:
        anything = {"anything": Recognised(0.5, ""), "surer": Recognised(2.0, "")}
        known = Recognised(0.5, "transforms.json") if (data / "transforms.json").exists() else None
        return anything.get(self.wrong, known)

    def build(self) -> DataParser:
        return Parser(self.wrong)


def test_built_in_and_plain_parsers_pass(tmp_path: Path) -> None:
    for config, write in (
        (TransformsConfig(), write_transforms),
        (LlffConfig(), write_llff),
        (ColmapConfig(), write_colmap),
    ):
        write(tmp_path / write.__name__, Capture.make(9))  # type: ignore[operator]
        check_parser(config, tmp_path / write.__name__)
    check_parser(ParserConfig(), tmp_path / "write_transforms")


@pytest.mark.parametrize(
    ("wrong", "error", "breach"),
    [
        ("mirrored", AssertionError, "right-handed"),
        ("scaled", AssertionError, "must be rotations"),
        ("float", AssertionError, "fp64"),
        ("split", AssertionError, "train and test"),
        ("paths", AssertionError, "8 paths but 9 cameras"),
        ("order", AssertionError, "the same each time"),
        ("size", AssertionError, "must divide the size"),
        ("anything", AssertionError, "must not recognise a folder that is absent"),
        ("surer", AssertionError, r"in \(0, 1\]"),
        ("absent", FileNotFoundError, "no-such-folder"),
    ],
)
def test_a_breach_of_a_parser_is_told(
    tmp_path: Path, wrong: str, error: type[Exception], breach: str
) -> None:
    write_transforms(tmp_path, Capture.make(9))
    with pytest.raises(error, match=breach):
        check_parser(ParserConfig(wrong=wrong), tmp_path)
