"""Built-in parsers keep to their contract, and each breach of a stranger's is told."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from capture_files import Capture, write_colmap, write_llff, write_transforms

from fprf.datamanagers.parsers.config import ColmapConfig, DataParserConfig, LlffConfig, Recognised, TransformsConfig
from fprf.datamanagers.scene import Scene
from fprf.interfaces import DataParser
from fprf.testing import check_parser


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
