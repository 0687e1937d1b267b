"""Every JSON file of a run, spoilt: what reads it gives a value or an error of one line, whatever is in the
file.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.town.write import write_town
from fprf.blocks.config import BisectConfig
from fprf.blocks.partition import write_cells
from fprf.blocks.windows import cut_into_windows
from fprf.config_files import save_config
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import CheckpointError, FprfError
from fprf.io import tensorfiles
from fprf.io.atomic import write_json
from fprf.methods import fprf_lite
from fprf.rendering.space import Space
from fprf.splats import cells
from fprf.splats.cells import Cells, load_cells
from fprf.splats.config import GaussiansConfig
from fprf.training import blocks, checkpoint
from fprf.training.blocks import load_blocks, load_finished
from fprf.training.facts import Facts, FieldFacts
from fprf.training.field_learner import training_summary
from fprf.training.history import read_history
from fprf.training.image_hashes import check_images, image_hashes, save_image_hashes
from fprf.training.run import Run
from fprf.training.tasks import WHOLE, begin, read_done, renumber, task_of
from fprf.types import Cell

LARGE = "1" + "0" * 400
JUNK = (
    "null",
    "true",
    "-1",
    "0.5",
    "1e300",
    "1e999",
    "NaN",
    "9" * 30,
    LARGE,
    "9" * 5000,
    '"x"',
    r'"\ud800"',
    "[]",
    "{}",
)
JUNK += ("[[]]", '{"format": 1}', '{"a": 1, "a": 2}', "[" * 500 + "]" * 500, "[" * 10**5)
MARK = "what stands in the place of junk"
TENSORS = {"planes": torch.arange(6.0)}


@dataclass(frozen=True)
class Example:
    """A run in blocks and in cells at once, with the least that its files may hold."""

    root: Path
    scene: ParsedScene
    content: dict[Path, bytes]

    @property
    def parts(self) -> tuple[Path, ...]:
        """Folders of a block, of the whole scene and of a cell."""
        return (
            blocks.folder_of(self.root, 0),
            cells.folder_of(self.root, WHOLE),
            cells.folder_of(self.root, 1),
        )

    def cells(self) -> Cells:
        """Its scene, ready to be cut into cells."""
        config = GaussiansConfig(data=self.root.parent / "town", cells=BisectConfig())
        cut = cut_into_windows(self.scene, config.cells)
        return Cells(config, self.scene, cut, Run(self.root).load_known().facts)

    def documents(self) -> list[Path]:
        return [path for path in self.content if path.suffix in (".json", ".jsonl")]

    def restore(self) -> None:
        for path, content in self.content.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def readers(self) -> Iterator[Callable[[], object]]:
        root = self.root
        yield Run(root).load_config
        yield Run(root).load_known
        yield lambda: check_images(root, self.scene, image_hashes(self.scene))
        yield lambda: read_history(root)
        yield lambda: training_summary(Run(root), fprf_lite(), self.scene)
        yield lambda: load_blocks(root)
        yield lambda: load_finished(self.parts[0])
        yield lambda: renumber(root / "blocks", {1: "other"})
        yield lambda: load_cells(root)
        yield lambda: [read_done(folder) for folder in self.parts]
        yield lambda: [checkpoint.load_latest(folder / "checkpoints") for folder in self.parts]
        yield lambda: [begin(folder, task_of(folder) or "other") for folder in self.parts]


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Example:
    folder = tmp_path_factory.mktemp("spoilt")
    town = folder / "town"
    root = folder / "run"
    write_town(town, seed=0, palette="day", views=4, width=96, height=72)
    scene = parse_scene(town, 1, None)
    run = Run(root)
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    facts = Facts(
        space=Space("box", (0.0, 0.0, 0.0), axes, 1.0, 0.1, 9.0), background=(0.0, 0.5, 1.0), exposure=(0.1,) * 4,
        centres=axes, field=FieldFacts(channels=4, dim=2, content_encoder="a", semantic_encoder="b"),
    )  # fmt: skip
    save_config(root / "config.json", fprf_lite(), "fprf-lite")
    run.save_known(scene, town, facts)
    save_image_hashes(root, image_hashes(scene))
    corner = torch.ones(3, dtype=torch.float64)
    write_cells(root / "blocks.json", [Cell(low=-corner, high=corner, border=corner / 2)])
    made = Example(root, scene, {})
    made.cells().write(run)
    for part, task in zip(made.parts, ("a", "b", "c"), strict=True):
        begin(part, task)
        manifest = tensorfiles.save(part / "block.safetensors", TENSORS)
        done = {"format": 1, "asked": {"task": "a"}, "step": 3, "seconds": 1.5, "tensors": manifest}
        write_json(part / "done.json", done)
        checkpoint.write(part / "checkpoints", TENSORS, TENSORS, step=3, seconds=1.5)
        Run(part).log({"step": 3, "seconds": 1.5, "psnr": 20.0, "losses": {"rgb": 0.1}})
    made.content.update({path: path.read_bytes() for path in root.rglob("*") if path.is_file()})
    return made


def lines_of(path: Path, text: str) -> list[str]:
    return text.splitlines() if path.suffix == ".jsonl" else [text]


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Each container in a JSON value, with each of its keys; of long lists the first two items."""
    for key in (
        list(value) if isinstance(value, dict) else range(len(value))[:2] if isinstance(value, list) else ()
    ):
        yield value, key
        yield from places(value[key])


@st.composite
def spoilt(draw: st.DrawFn, path: Path, text: str) -> str:
    """A text cut off, or one of whose values is lost or replaced."""
    if draw(st.integers(0, 4)) == 0:
        return text[: draw(st.integers(0, len(text)))]
    lines = lines_of(path, text)
    at = draw(st.integers(0, len(lines) - 1))
    whole = [json.loads(lines[at])]
    container, key = draw(st.sampled_from(list(places(whole))))
    if container is not whole and draw(st.integers(0, 4)) == 0:
        del container[key]
    else:
        container[key] = MARK
    lines[at] = json.dumps(whole[0]).replace(json.dumps(MARK), draw(st.sampled_from(JUNK)))
    return "\n".join(lines)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_spoilt_file_is_read_or_refused_in_one_line(example: Example, data: st.DataObject) -> None:
    path = data.draw(st.sampled_from(example.documents()))
    text = data.draw(spoilt(path, example.content[path].decode()))
    for read in example.readers():
        path.write_text(text)
        try:
            read()
        except FprfError as error:
            assert str(example.root) in str(error) and len(str(error)) < 1000
    example.restore()


def test_what_is_not_spoilt_is_read(example: Example) -> None:
    for read in example.readers():
        read()
    example.restore()


def test_a_part_whose_task_is_damaged_is_begun_anew(example: Example) -> None:
    for part in example.parts:
        (part / "task.json").write_text('{"task": "a')
        begin(part, "d")
        assert (
            task_of(part) == "d"
            and not (part / "done.json").exists()
            and not checkpoint.steps(part / "checkpoints")
        )
    example.restore()


def test_a_spoilt_cut_is_named_and_its_cells_stay(example: Example) -> None:
    (example.root / "cells.json").write_text('{"format')
    with pytest.raises(CheckpointError, match=r"cells\.json"):
        example.cells().write(Run(example.root))
    assert (example.parts[2] / "done.json").exists()
    example.restore()


def test_a_line_of_events_with_a_number_too_large_is_passed_over(example: Example) -> None:
    events = example.parts[0] / "events.jsonl"
    events.write_text(
        events.read_text() + f'{{"step": 4, "seconds": {LARGE}}}\n{{"step": {LARGE}, "seconds": 2}}\n'
    )
    events.write_text(events.read_text() + '{"step": 5, "seconds": 3, "psnr": 1e308}\n')
    (history,) = (each for each in read_history(example.root) if each.name in ("", example.parts[0].name))
    assert history.step == [3, 5] and history.values["psnr"] == [20.0, None]
    example.restore()
