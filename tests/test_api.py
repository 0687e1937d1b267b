import dataclasses
import html
import inspect
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from splat_ball import ball
from tiny_world import World

import fprf
from fprf.api import FinishedCapture, TrainedScene
from fprf.cli import main as cli
from fprf.errors import CheckpointError, ConfigError, DataError, FprfError, UsageError
from fprf.io.memory_pictures import photograph_files
from fprf.progress import Progressed
from fprf.rendering.cameras import project
from fprf.splats.files import write_gaussians
from fprf.style.config import StyleConfig


@pytest.fixture(scope="module")
def scene(_world: World) -> TrainedScene:
    """Loaded once: its encoders, too."""
    return fprf.load(_world.run, device="cpu")


def test_five_lines_do_what_the_verbs_do(world: World, tmp_path: Path) -> None:
    scene = fprf.load(world.run, device="cpu")
    dusk = scene.stylize([world.references[0]], strength=0.8)
    shot = dusk.render(scene.camera("0008"))
    shot.save(tmp_path / "dusk.png")

    shutil.copytree(world.run, tmp_path / "run")
    args = [
        "stylize",
        str(tmp_path / "run"),
        "--references",
        str(world.references[0]),
        "--strength",
        "0.8",
        "--views",
        "0008",
    ]
    assert cli.main([*args, "--output", str(tmp_path / "verb"), "--device", "cpu"]) == 0
    mine, theirs = (cv2.imread(str(path)) for path in (tmp_path / "dusk.png", tmp_path / "verb" / "0008.png"))
    assert mine.shape == (24, 32, 3) and np.array_equal(mine, theirs)


def test_scenes_never_change(scene: TrainedScene, world: World) -> None:
    before = scene.render(0).rgb
    styled = scene.stylize(world.references)
    assert scene.styled is None and torch.equal(scene.render(0).rgb, before)
    assert not torch.equal(styled.render(0).rgb, before)
    assert set(styled.references) == {"dusk.png", "snow.png"} and scene.references == ()
    assert torch.equal(styled.plain().render(0).rgb, before)
    assert torch.equal(scene.stylize(world.references, strength=0).render(0).rgb, before)
    assert styled.trained is scene.trained and styled.encoders is scene.encoders


def test_a_style_file_goes_out_and_comes_back(scene: TrainedScene, world: World, tmp_path: Path) -> None:
    styled = scene.stylize(world.references, weights=[1, 3], keep=["1"], luminance=0.5)
    styled.save_style(tmp_path / "style.json")
    assert json.loads((tmp_path / "style.json").read_text())["style"]["weights"] == [1, 3]
    again = scene.apply(tmp_path / "style.json")
    assert torch.allclose(styled.render(2).rgb, again.render(2).rgb, atol=1e-6)
    config = StyleConfig(references=world.references, weights=(1, 3), keep=("1",), luminance=0.5)
    assert torch.equal(styled.render(2).rgb, scene.apply(config).render(2).rgb)
    folder = tmp_path / "folder"
    folder.mkdir()
    for path in world.references:
        shutil.copy(path, folder)
    (tmp_path / "by_hand.json").write_text('{"format": 1, "style": {"references": ["folder"]}}')
    assert set(scene.apply(tmp_path / "by_hand.json").references) == {"dusk.png", "snow.png"}
    between = scene.apply(replace(config, between=tmp_path / "by_hand.json"))
    between.save_style(tmp_path / "between.json")
    with pytest.raises(UsageError, match="a mix has no file"):
        between.towards(styled, 0.5).save_style(tmp_path / "mix.json")


def test_matches_of_any_camera(scene: TrainedScene, world: World) -> None:
    styled = scene.stylize(world.references)
    captured = styled.matches("0002")
    moved = styled.matches(styled.path("orbit", 5).select(torch.tensor([2])))
    codes = len(styled.styled.codes.reference)  # type: ignore[union-attr]
    assert captured.taken.shape == moved.taken.shape == (24, 32, codes)
    assert not torch.equal(captured.taken, moved.taken)
    seen = captured.opacity > 0.5
    assert torch.allclose(captured.taken.sum(-1)[seen], torch.ones(int(seen.sum())), atol=1e-3)


def test_a_camera_of_ones_own_looks_where_it_should(scene: TrainedScene) -> None:
    position = scene.cameras.pose[0, :, 3].tolist()
    target = [20.0, 1.0, 2.0]
    camera = scene.camera_at(position, target, fov=50, width=40, height=20)
    pixel, depth = project(camera, torch.tensor([0]), torch.tensor([target], dtype=torch.float64))
    assert torch.allclose(pixel, torch.tensor([[20.0, 10.0]], dtype=torch.float64)) and float(depth) > 0
    above = torch.tensor([[*target[:2], target[2] + 1]], dtype=torch.float64)
    assert float(project(camera, torch.tensor([0]), above)[0][0, 1]) < 10, "up is up"
    assert scene.render(camera).rgb.shape == (20, 40, 3)
    # The vertical angle: what lies half of it above the axis is at the edge.
    assert float(camera.focal[0, 1]) == pytest.approx(10 / np.tan(np.radians(25)))


def test_mistakes_are_told(scene: TrainedScene, world: World, tmp_path: Path) -> None:
    mistakes: list[tuple[type[FprfError], Callable[[], object]]] = [
        (CheckpointError, lambda: fprf.load(tmp_path)),
        (UsageError, lambda: scene.camera("00003")),
        (UsageError, lambda: scene.camera(10)),
        (UsageError, lambda: scene.render(scene.cameras)),
        (UsageError, lambda: scene.matches(0)),
        (UsageError, lambda: scene.save_style(tmp_path / "style.json")),
        (UsageError, lambda: scene.towards(scene.stylize([world.references[0]]), 0.5)),
        (UsageError, lambda: scene.stylize([])),
        (ConfigError, lambda: scene.stylize(world.references, weights=[1, 2, 3])),
        (DataError, lambda: scene.stylize([tmp_path / "absent.png"])),
        (UsageError, lambda: scene.camera_at([0, 0, 0], [0, 0, 0])),
        (ConfigError, lambda: scene.camera_at([0, 0, 0], [1, 0, 0], fov=180)),
        (UsageError, lambda: scene.path("spirale")),
        (DataError, lambda: scene.render(0).save(tmp_path / "x.txt")),
    ]
    for kind, mistake in mistakes:
        with pytest.raises(kind):
            mistake()


def test_a_notebook_shows_the_scene_as_a_page(scene: TrainedScene, world: World) -> None:
    for shown, names in ((scene, ["Captured"]), (scene.stylize([world.references[0]]), ["Captured", "dusk"])):
        frame = shown._repr_html_()
        assert frame.startswith('<iframe srcdoc="') and 'sandbox="allow-scripts"' in frame
        page = html.unescape(frame.partition('srcdoc="')[2].partition('" sandbox')[0])
        data = json.loads(page.partition('id="data">')[2].partition("</script>")[0])
        assert [style["name"] for style in data["styles"]] == names


def test_a_notebook_shows_a_capture_as_a_page_that_opens_in_its_style(world: World, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "ball.ply", ball(300, 1))
    capture = fprf.read(tmp_path / "ball.ply")
    styled = capture.restyled([world.references[0]])
    for shown, names in ((capture, ["Captured"]), (styled, ["Captured", "dusk"])):
        page = html.unescape(shown._repr_html_().partition('srcdoc="')[2].partition('" sandbox')[0])
        data = json.loads(page.partition('id="data">')[2].partition("</script>")[0])
        assert [style["name"] for style in data["styles"]] == names and data["scene"]["count"] == 300


@pytest.mark.parametrize("method", [TrainedScene.stylize, FinishedCapture.restyled])
def test_every_field_of_a_style_is_an_argument(method: Callable[..., object]) -> None:
    given = dict(inspect.signature(method).parameters)
    for name in ("self", "preset", "match_light"):
        given.pop(name, None)
    fields = {each.name: each for each in dataclasses.fields(StyleConfig)}
    assert given.keys() == fields.keys()
    for name, parameter in given.items():
        # No slot as a default: which stylizer it is depends on the scene.
        own = None if name == "stylizer" else fields[name].default
        assert name == "references" or parameter.default == own, name


def test_a_reference_may_be_a_picture_in_memory(scene: TrainedScene, world: World, tmp_path: Path) -> None:
    file = world.references[0]
    by_file = scene.stylize(file).render(0).rgb
    picture = Image.open(file)
    floats = np.asarray(picture.convert("RGB"), np.float32) / 255
    for held in (picture, np.asarray(picture), floats, torch.from_numpy(floats), [picture]):
        assert torch.equal(scene.stylize(held).render(0).rgb, by_file)
    both = scene.stylize([file, picture.rotate(180)], pin="0=0")
    assert both.references[0] == file.name and len(both.references) == 2
    # A style that is saved carries them along.
    both.save_style(tmp_path / "mine.json")
    assert {path.name for path in tmp_path.iterdir()} >= {"mine.json", "mine-1.png"}
    assert torch.equal(scene.apply(tmp_path / "mine.json").render(0).rgb, both.render(0).rgb)
    for wrong in (np.zeros((4, 4), np.uint8), np.full((4, 4, 3), 2.0), np.zeros((4, 4, 3), np.int64)):
        with pytest.raises(DataError, match="references: "):
            scene.stylize(wrong)
    with pytest.raises(DataError, match=r"references: None; a photograph is"):
        photograph_files(None)  # type: ignore[arg-type]


def test_what_is_printed_of_results_is_one_line(scene: TrainedScene, world: World, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "scan.ply", ball(20))
    scan = fprf.read(tmp_path / "scan.ply")
    grey = scan.recoloured(scan.gaussians.harmonics * 0)
    styled = scene.stylize(world.references[0])
    printed = [repr(each) for each in (scene, styled, scene.render(0), scan, grey)]
    assert all(len(line) < 120 and "tensor" not in line for line in printed)
    assert len(set(printed)) == len(printed) and world.references[0].stem in printed[1]


def test_pictures_are_upright_and_keep_profile_and_transparency(tmp_path: Path) -> None:
    turned = Image.fromarray(np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    exif = Image.Exif()
    exif[0x0112] = 6
    turned.save(tmp_path / "turned.png", exif=exif, icc_profile=b"a profile")
    with Image.open(tmp_path / "turned.png") as opened:
        (file,) = photograph_files(opened)
    with Image.open(file) as found:
        assert found.size == (2, 4) and found.info["icc_profile"] == b"a profile"
    (clear,) = photograph_files(Image.new("RGBA", (3, 3), (9, 8, 7, 0)))
    with Image.open(clear) as found:
        assert found.mode == "RGBA" and found.getpixel((0, 0)) == (9, 8, 7, 0)


def test_shots_are_pictures_for_pillow_and_notebooks(scene: TrainedScene) -> None:
    shot = scene.render(0)
    assert np.array_equal(np.asarray(shot.image), shot.pixels)
    assert shot._repr_png_().startswith(b"\x89PNG")


def test_training_goes_on_where_it_was_stopped(world: World, tmp_path: Path) -> None:
    told: list[Progressed] = []

    def stop_soon(news: Progressed) -> None:
        told.append(news)
        if news.what == "training":
            raise fprf.Stopped

    # By steps: how much a wall-clock budget allows depends on the machine.
    config = replace(world.config, steps=6, minutes=None)
    with pytest.raises(fprf.Stopped), pytest.MonkeyPatch.context() as patched:
        patched.setattr("fprf.training.driver.REPORT_SECONDS", 0.0)
        fprf.train(world.town, "fprf-lite", output=tmp_path / "run", config=config, progress=stop_soon)
    assert told and all(0 <= news.share <= 1 for news in told)
    assert 0 < fprf.load(tmp_path / "run").trained.step < 6
    heard: list[Progressed] = []
    scene = fprf.train(
        world.town, "fprf-lite", output=tmp_path / "run", config=config, progress=heard.append, device="cpu"
    )
    assert scene.trained.step == 6 and heard[-1].share == 1
    # Files of others are not touched.
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "events.jsonl").write_text("mine")
    with pytest.raises(UsageError, match="no run has written it"):
        fprf.train(world.town, "fprf-lite", output=tmp_path / "other", config=config)
    assert (tmp_path / "other" / "events.jsonl").read_text() == "mine"


def test_process_is_that_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--output .*holds something else"):
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "letter.txt").write_text("")
        fprf.process(tmp_path, tmp_path / "full")
