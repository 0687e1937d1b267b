"""Which parser a folder gets, the same scene in every format, and the contract that parsers keep."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from capture_files import Capture, write_colmap, write_llff, write_transforms
from fake_packages import packages_in

from fprf.datamanagers.parsers.config import (
    ColmapConfig,
    DataParserConfig,
    LlffConfig,
    Recognised,
    TransformsConfig,
    parse_scene,
    recognise,
)
from fprf.datamanagers.scene import Scene
from fprf.errors import DataError
from fprf.interfaces import DataParser
from fprf.rendering.cameras import project, rays_through
from fprf.testing import check_parser


def rays(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """A few rays of every view, at the same share of each image."""
    view = torch.arange(len(scene.cameras)).repeat_interleave(4)
    share = torch.tensor([[0.1, 0.2], [0.9, 0.15], [0.5, 0.5], [0.3, 0.95]], dtype=torch.float64)
    return rays_through(scene.cameras, view, share.repeat(len(scene.cameras), 1) * scene.cameras.size[view])


def assert_same(one: Scene, other: Scene, tolerance: float = 1e-12) -> None:
    assert [path.stem for path in one.paths] == [path.stem for path in other.paths]
    assert torch.equal(one.train, other.train) and torch.equal(one.test, other.test)
    for a, b in zip(rays(one), rays(other), strict=True):
        assert (a - b).abs().max() <= tolerance


@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_one_capture_in_every_format_has_the_same_rays(tmp_path: Path, downscale: int) -> None:
    capture = Capture.make(9)
    write_transforms(tmp_path / "transforms", capture)
    write_llff(tmp_path / "llff", capture)
    write_llff(tmp_path / "llff_8", capture, images="images_8", factor=8)
    write_colmap(tmp_path / "colmap", capture)
    write_colmap(tmp_path / "text", capture, binary=False)
    first = parse_scene(tmp_path / "transforms", downscale, None)
    for name in ("llff", "llff_8", "colmap", "text"):
        assert_same(first, parse_scene(tmp_path / name, downscale, None))


def test_formats_are_told_by_their_files(tmp_path: Path) -> None:
    capture = Capture.make(2)
    write_colmap(tmp_path, capture)
    assert recognise(tmp_path) == ColmapConfig()
    (tmp_path / "transforms_4.json").write_text("{}")
    assert recognise(tmp_path) == ColmapConfig()
    write_llff(tmp_path, capture)
    assert recognise(tmp_path) == LlffConfig()
    write_transforms(tmp_path, capture)
    assert recognise(tmp_path) == TransformsConfig()


def test_blender_and_a_single_file_of_another_name(tmp_path: Path) -> None:
    write_transforms(tmp_path, Capture.make(3))
    whole = parse_scene(tmp_path, 1, None)
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_4.json")
    assert recognise(tmp_path) == TransformsConfig()
    assert_same(parse_scene(tmp_path, 1, None), whole)
    (tmp_path / "transforms_8.json").write_text("{}")
    with pytest.raises(DataError, match="but 4 entries"):
        recognise(tmp_path)
    (tmp_path / "transforms_train.json").write_text("{}")
    assert recognise(tmp_path) == TransformsConfig()


def test_what_was_found_is_said(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        recognise(tmp_path / "absent")
    for name in "abcdefg":
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"but 7 entries \(a, b, c, d, e, \.\.\.\)"):
        recognise(tmp_path)
    with pytest.raises(DataError, match="a file; give the scene folder"):
        recognise(tmp_path / "a")


PARSER = """
from dataclasses import dataclass
from fprf.datamanagers.parsers.config import DataParserConfig, Recognised

@dataclass(frozen=True, kw_only=True)
class ScanConfig(DataParserConfig):
    def recognises(self, data):
        return {answer}
"""
SCAN = 'Recognised({confidence}, "scan.bin") if (data / "scan.bin").is_file() else None'


def test_a_strangers_parser_recognises_its_folders(tmp_path: Path) -> None:
    folder, site = tmp_path / "scene", tmp_path / "site"
    write_colmap(folder, Capture.make(2))
    site.mkdir()
    with packages_in(site) as packages:
        for name, confidence in (("sure", 0.6), ("even", 0.5), ("faint", 0.2)):
            code = {f"acme_{name}": PARSER.format(answer=SCAN.format(confidence=confidence).replace("scan", name))}
            packages.install(f"acme-{name}", {"fprf.dataparsers": {name: f"acme_{name}:ScanConfig"}}, code=code)
        (folder / "faint.bin").touch()
        assert recognise(folder) == ColmapConfig()
        (folder / "even.bin").touch()
        with pytest.raises(
            DataError, match=r"by 'colmap' \(a model in .*\) and by 'even' \(even\.bin\); choose one with --data"
        ) as caught:
            recognise(folder)
        assert "\n" not in str(caught.value)
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
        ("from fprf.fields.layouts import SingleConfig as ScanConfig", "not a DataParserConfig"),
    ],
)
def test_a_broken_parser_is_named_and_skipped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str, told: str
) -> None:
    folder, site = tmp_path / "scene", tmp_path / "site"
    write_colmap(folder, Capture.make(2))
    site.mkdir()
    with packages_in(site) as packages:
        packages.install("acme-bad", {"fprf.dataparsers": {"bad": "acme_bad4:ScanConfig"}}, code={"acme_bad4": source})
        assert recognise(folder) == ColmapConfig()
        (line,) = capsys.readouterr().err.splitlines()
        assert (
            line.startswith("warning: data parser 'bad' (acme_bad4:ScanConfig from acme-bad 1) is skipped: ") and told in line
        )
        (folder / "sparse").rename(folder / "elsewhere")
        with pytest.raises(DataError, match=r"for Gaussians --parser NAME \(bad, blocknerf"):
            recognise(folder)


SCENES = ["blender_lego", "drone_caliterra", "fox", "llff_fern", "llff_flower", "m360_bonsai", "street_lund"]


@pytest.mark.parametrize("name", SCENES)
def test_real_scenes(shared: Path, name: str) -> None:
    folder = shared / "data" / "scenes" / name
    scene = parse_scene(folder, 1, None)
    others: list[DataParserConfig] = []
    if (folder / "poses_bounds.npy").exists():
        others.append(LlffConfig(images="images_8"))
        assert_same(scene, parse_scene(folder, 1, LlffConfig(images="images_4")))
        assert_same(scene, parse_scene(folder, 1, TransformsConfig(file="transforms_4.json")))
    if (folder / "sparse").exists():
        others.append(ColmapConfig())
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
        self.wrong, self.calls = wrong, 0

    def parse(self, data: Path, downscale: int) -> Scene:
        self.calls += 1
        if self.wrong == "absent" and not data.exists():
            raise FileNotFoundError(data)
        scene = TransformsConfig().build().parse(data, 1 if self.wrong == "size" else downscale)
        pose = scene.cameras.pose
        changed: dict[str, Callable[[], Scene]] = {
            "mirrored": lambda: replace(scene, cameras=replace(scene.cameras, pose=pose * torch.tensor([[-1.0, 1, 1, 1]]))),
            "scaled": lambda: replace(scene, cameras=replace(scene.cameras, pose=2 * pose)),
            "float": lambda: replace(scene, cameras=replace(scene.cameras, pose=pose.float())),
            "split": lambda: replace(scene, test=scene.train[:1]),
            "paths": lambda: replace(scene, paths=scene.paths[1:]),
            "order": lambda: replace(scene, paths=scene.paths[:: 1 if self.calls == 1 else -1]),
        }
        return changed.get(self.wrong, lambda: scene)()


@dataclass(frozen=True, kw_only=True)
class ParserConfig(DataParserConfig):
    wrong: str = ""

    def recognises(self, data: Path) -> Recognised | None:
        anything = {"anything": Recognised(0.5, ""), "surer": Recognised(2.0, "")}
        known = Recognised(0.5, "transforms.json") if (data / "transforms.json").exists() else None
        return anything.get(self.wrong, known)

    def build(self) -> DataParser:
        return Parser(self.wrong)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One capture in three formats."""
    folder = tmp_path_factory.mktemp("capture")
    for write in (write_transforms, write_llff, write_colmap):
        write(folder / write.__name__, Capture.make(9))
    return folder


def test_built_in_and_plain_parsers_pass(capture: Path) -> None:
    for config, name in ((TransformsConfig(), "transforms"), (LlffConfig(), "llff"), (ColmapConfig(), "colmap")):
        check_parser(config, capture / f"write_{name}")
    check_parser(ParserConfig(), capture / "write_transforms")


@pytest.mark.parametrize(
    ("wrong", "error", "breach"),
    [
        ("mirrored", AssertionError, "right-handed"),
        ("scaled", AssertionError, "must be rotations"),
        ("float", AssertionError, "fp64"),
        ("split", AssertionError, "train and test"),
        ("paths", AssertionError, "8 paths but 9 cameras"),
        ("order", AssertionError, "the same each time"),
        ("size", AssertionError, "must halve the size"),
        ("anything", AssertionError, "must not recognise a folder that is absent"),
        ("surer", AssertionError, r"in \(0, 1\]"),
        ("absent", FileNotFoundError, "no-such-folder"),
    ],
)
def test_a_breach_of_a_parser_is_told(capture: Path, wrong: str, error: type[Exception], breach: str) -> None:
    with pytest.raises(error, match=breach):
        check_parser(ParserConfig(wrong=wrong), capture / "write_transforms")
