"""`fprf render`, `gallery`, `eval`, `export` and `demo`."""

import json
import re
import shutil
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from unittest.mock import DEFAULT, Mock

import cv2
import numpy as np
import pytest
import torch
import trimesh
from tiny_world import World

import fprf.methods
from fprf.cli import main as cli
from fprf.cli.eval import write_scalars
from fprf.datamanagers.parsers.config import parse_scene
from fprf.evaluation.metrics import psnr
from fprf.export.fit import seen_points
from fprf.export.mesh import default_reach, render_maps
from fprf.io import images
from fprf.io.overwriting import Origin
from fprf.rendering.paths import make_path, write_camera_path
from fprf.splats.drawing import draw
from fprf.splats.files import read_capture
from fprf.splats.pinholes import camera_of
from fprf.training.history import History

CAPTURED = ["--path", "dataset", "--split", "test"]
ORBIT = ["--path", "orbit", "--frames"]


def pictures(folder: Path) -> dict[str, np.ndarray]:
    return {p.name: cv2.imread(str(p)) for p in sorted(folder.glob("*.png"))}


def render(run: Path, output: Path, *words: str) -> dict[str, np.ndarray]:
    assert cli.main(["render", str(run), *words, "--output", str(output)]) == 0
    return pictures(output)


def test_captured_views_keep_their_names_and_are_those_of_eval(run: Path, tmp_path: Path) -> None:
    frames = render(run, tmp_path / "frames", *CAPTURED)
    assert cli.main(["eval", str(run)]) == 0
    plain = pictures(run / "renders" / "test")
    assert frames.keys() == plain.keys() == {"0000.png", "0008.png"}
    assert all(np.array_equal(frames[name], plain[name]) for name in frames)


def test_a_gif_is_a_file(run: Path, world: World, tmp_path: Path) -> None:
    render(
        run, tmp_path / "a.gif", "--path", "spiral", "--frames", "2", "--references", str(world.references[0])
    )
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF89a") and len(list(tmp_path.glob("[!.]*"))) == 2


def test_several_looks_and_channels_lie_beside_each_other(run: Path, world: World, tmp_path: Path) -> None:
    dusk = f"dusk={world.references[0]}"
    styles = {
        "one": [dusk], "plain": [], "two": ["plain", dusk], "all": [dusk, "--show", "colour", "depth", "normals", "match"],
    }  # fmt: skip
    made = [render(run, tmp_path / name, *CAPTURED, "--styles", *words) for name, words in styles.items()]
    for one, plain, two, whole in zip(*(each.values() for each in made), strict=True):
        assert two.shape == (24, 66, 3) and whole.shape == (24, 134, 3)
        assert np.array_equal(two[:, :32], plain) and np.array_equal(two[:, 34:], one)
        assert np.array_equal(whole[:, :32], one)


def test_frames_that_are_there_are_not_made_again(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "frames"
    whole = render(run, out, *ORBIT, "4")
    stamps = {path.name: path.stat().st_mtime_ns for path in out.glob("*.png")}
    (out / "00002.png").unlink()
    capsys.readouterr()
    again = render(run, out, *ORBIT, "4")
    assert "3 of 4 frames are there already" in capsys.readouterr().out
    after = {path.name: path.stat().st_mtime_ns for path in out.glob("*.png")}
    assert [name for name in stamps if stamps[name] != after[name]] == ["00002.png"]
    assert all(np.array_equal(whole[name], picture) for name, picture in again.items())
    others = render(run, out, *ORBIT, "4", "--show", "depth")
    assert "are there already" not in capsys.readouterr().out, "other frames are other frames"
    assert not any(np.array_equal(whole[name], picture) for name, picture in others.items())


def test_an_interrupted_film_goes_on(
    run: Path, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = tmp_path / "x.mp4"
    args = ["render", str(run), *ORBIT, "4", "--output", str(film)]
    write = Mock(wraps=images.write_image, side_effect=[DEFAULT, DEFAULT, KeyboardInterrupt])
    monkeypatch.setattr(images, "write_image", write)
    assert cli.main(args) == 130 and not film.exists()
    write.side_effect = None
    (mine := tmp_path / "x.frames" / "00000.png").parent.mkdir()
    mine.write_text("stays")
    assert cli.main(args) == 0 and film.is_file()
    assert [call.args[0].name for call in write.call_args_list] == [f"0000{k}.png" for k in (0, 1, 2, 2, 3)]
    assert mine.read_text() == "stays" and not (tmp_path / ".x.frames").exists()
    write_camera_path(tmp_path / "path.json", make_path(world.load().cameras, [0], "dataset", 1), 5)
    assert cli.main(["render", str(run), "--path", str(tmp_path / "path.json"), "--output", str(film)]) == 2
    assert (
        cli.main(
            ["render", str(run), "--path", str(tmp_path / "path.json"), "--output", str(film), "--overwrite"]
        )
        == 0
    )
    assert cv2.VideoCapture(str(film)).get(cv2.CAP_PROP_FPS) == 5


def gallery(run: Path, *words: str) -> str:
    assert cli.main(["gallery", str(run), *words, "--device", "cpu"]) == 0
    return (run / "gallery.html").read_text("utf-8")


def data_of(page: str) -> Any:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert found is not None
    return json.loads(found[1])


def views(page: str) -> list[str]:
    """Names of the views, by the match maps of the style of all photographs."""
    maps = page.partition("Which reference each place")[2].partition("</article>")[0]
    return re.findall(r"<figcaption>([^<]*)</figcaption>", maps)


def test_a_folder_of_photographs_becomes_a_page(
    run: Path, world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = run.parent / "photos"
    photos.mkdir()
    for path in world.references:
        shutil.copy(path, photos)
    (photos / "notes.txt").write_text("not a photograph")
    (photos / "broken.jpg").write_bytes(b"not a photograph")
    page = gallery(run, "--references", str(photos), "--split", "test")
    data = data_of(page)
    assert [style["name"] for style in data["styles"]] == ["Captured", "dusk", "snow", "dusk + snow"]
    assert [len(rows) for rows in data["stills"].values()] == [2] * 4, "a run of fields is shown in pictures"
    assert page.count("Which reference each place") == 1, "match maps where there is a choice"
    assert page.count('alt="Photograph 000') == 2 and "http" not in page.replace("http-equiv", "")
    told = capsys.readouterr()
    assert f"2 views in 3 styles: {run / 'gallery.html'}" in told.out
    assert "broken.jpg: no PNG, JPEG" in told.err, "it is named, and the others are shown"


def test_views_are_chosen_evenly_or_by_name(run: Path, world: World) -> None:
    photo = ["--references", *map(str, world.references)]
    page = gallery(run, *photo, "--split", "all", "--most", "4")
    assert views(page) == ["0000", "0002", "0005", "0007"]
    page = gallery(run, *photo, "--views", "0007", "0001", "--title", "My <town>")
    assert views(page) == ["0007", "0001"]
    assert "My &lt;town&gt;" in page


def test_style_files_are_styles_of_the_page(run: Path, world: World) -> None:
    style = run.parent / "mine" / "style.json"
    style.parent.mkdir()
    references = [str(path) for path in world.references]
    style.write_text(json.dumps({"format": 1, "style": {"references": references, "strength": 0.5}}))
    page = gallery(run, "--styles", str(style), "--views", "0000")
    assert [style["name"] for style in data_of(page)["styles"]] == ["Captured", "mine"]
    captured = shutil.copy(references[0], run.parent / "Captured.jpg")
    page = gallery(run, "--references", str(captured), "--views", "0000", "--overwrite")
    assert [style["name"] for style in data_of(page)["styles"]] == ["Captured", "Captured (1)"]
    page = gallery(
        run, "--references", references[0], "--between", str(style), "--views", "0000", "--overwrite"
    )
    assert [style["name"] for style in data_of(page)["styles"]] == ["Captured", "dusk"], (
        "on the way to another style"
    )


KEYS = {
    "method", "scene", "split", "psnr", "cc_psnr", "ssim", "lpips", "views", "render_seconds", "seconds_per_view",
    "rays_per_second", "kept_samples_share", "peak_rss_mib", "train_seconds", "train_steps", "consistency", "per_view",
    "used_share",
}  # fmt: skip


def test_metrics_table_and_pictures(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(run)]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics.keys() >= KEYS and "fitted_poses" not in metrics
    assert (metrics["method"], metrics["split"]) == ("fprf-lite", "test")
    assert sorted(p.name for p in (run / "renders" / "test").glob("[!.]*")) == ["0000.png", "0008.png"]
    assert cv2.imread(str(run / "renders" / "test" / "0000.png")).shape == (24, 32, 3)
    table = capsys.readouterr().out
    assert "psnr" in table and f"{metrics['psnr']:.3f}" in table and "rays/s" in table


def test_data_that_has_moved(run: Path, world: World, tmp_path: Path) -> None:
    config = run / "config.json"
    config.write_text(config.read_text().replace(str(world.town), str(tmp_path / "gone")))
    shutil.copytree(world.town, tmp_path / "there")
    assert cli.main(["eval", str(run), "--data", str(tmp_path / "there"), "--no-images"]) == 0
    assert not (run / "renders").exists()


def test_each_photograph_is_judged_at_its_own_size_up_to_a_limit(
    run: Path, world: World, tmp_path: Path
) -> None:
    town = shutil.copytree(world.town, tmp_path / "town")
    manifest = town / "transforms.json"
    document = json.loads(manifest.read_text())
    document["frames"][0] |= {key: 2 * document[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    manifest.write_text(json.dumps(document))
    photo = cv2.imread(str(town / "images/0000.png"))
    cv2.imwrite(str(town / "images/0000.png"), cv2.resize(photo, (64, 48)))
    assert cli.main(["eval", str(run), "--data", str(town), "--size", "40"]) == 0
    shapes = [picture.shape for picture in pictures(run / "renders" / "test").values()]
    assert shapes == [(30, 40, 3), (24, 32, 3)]


HISTORY = History("", [10, 20], [1.5, 3.0], {"psnr": [12.0, None], "colour": [0.5, 0.25]}, [])


def read(folder: Path) -> dict[str, list[tuple[int, float, float]]]:
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = reader.EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [(e.step, e.wall_time, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }


def test_what_is_written_is_read(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    block = HISTORY._replace(name="02")
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "mine.jpg").touch()
    for _ in range(2):  # again, in place of the first
        assert write_scalars(tmp_path, [HISTORY, block], Origin(by="eval")) == 6
    assert {path.name for path in tmp_path.iterdir()} == {"training", "02"}
    assert len(list(tmp_path.glob("*/events.out*"))) == 2 and (tmp_path / "training" / "mine.jpg").exists()
    found = read(tmp_path / "training")
    assert (
        found
        == {"psnr": [(10, 1.5, 12.0)], "colour": [(10, 1.5, 0.5), (20, 3.0, 0.25)]}
        == read(tmp_path / "02")
    )


GARDEN = Path(str(files("fprf") / "garden"))


def test_the_demo_from_nothing_to_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = replace(fprf.methods.fprf_splats(), steps=10, initial=800, cap=900)
    monkeypatch.setattr(fprf.methods, "fprf_splats", lambda: small)
    out = tmp_path / "out"
    args = ["demo", "--output", str(out), "--minutes", "5", "--downscale", "8"]
    assert cli.main(args) == 0
    styles = ["all-together.ply", "morning.ply", "night.ply", "sunrise.ply", "sunset.ply"]
    assert {p.name for p in out.iterdir()} >= {"run", "metrics.json", "garden.html", *styles}
    plain, *others = [
        read_capture(out / name).gaussians for name in ("night.ply", "sunrise.ply", "sunset.ply")
    ]
    assert all(
        torch.equal(plain.means, each.means) and not torch.equal(plain.harmonics, each.harmonics)
        for each in others
    )
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["method"], metrics["scene"], metrics["views"], metrics["train_steps"]) == (
        "fprf-splats",
        "garden",
        4,
        10,
    )
    assert metrics["total_seconds"] > metrics["new_style_seconds"] > 0
    page = (out / "garden.html").read_text()
    markup = re.sub(r"<script\b.*?</script>", "", page, flags=re.DOTALL)
    assert "CC0" in page and not re.findall(r"""(?:src|href)=["'](?!data:|#)""", markup), "it loads nothing"
    assert f"open {out / 'garden.html'}" in capsys.readouterr().out


def test_held_out_views_of_the_garden_are_surrounded_by_others() -> None:
    scene = parse_scene(GARDEN, 1, None)
    assert len(scene.train) == 21 and scene.points is not None
    train, test = ([int(view) for view in views] for views in (scene.train, scene.test))
    assert len(test) == 4 and all({view - 1, view + 1} <= {*train} for view in test)


def test_photographs_that_ship_are_credited_and_small() -> None:
    credits = (GARDEN / "README.md").read_text()
    references = sorted((GARDEN / "references").iterdir())
    assert references and all(path.stem in credits for path in references)
    assert all(max(cv2.imread(str(path)).shape) <= 640 for path in references)
    assert sum(path.stat().st_size for path in GARDEN.rglob("*") if path.is_file()) < 3e6


def export(world: World, *args: str) -> int:
    return cli.main(["export", str(world.run), *args])


def test_cameras_with_pictures_are_a_scene_of_its_own(world: World, tmp_path: Path) -> None:
    style = ["--references", str(world.references[0])]
    assert export(world, "cameras", "--images", *style, "--output", str(tmp_path)) == 0
    scene = parse_scene(tmp_path, 1, None)
    before = world.load().known
    assert np.allclose(scene.cameras.pose, before.cameras.pose, atol=1e-12)
    assert scene.train.tolist() == list(before.train) and scene.test.tolist() == list(before.test)
    styled = [*style, "--split", "all", "--no-matches", "--output", str(tmp_path / "styled")]
    assert cli.main(["stylize", str(world.run), *styled]) == 0
    for path, name in zip(scene.paths, before.names, strict=True):
        assert np.array_equal(cv2.imread(str(path)), cv2.imread(str(tmp_path / "styled" / f"{name}.png")))


def test_bounds_and_options_reach_the_mesh(world: World, tmp_path: Path) -> None:
    def made(*args: str) -> dict[str, float]:
        assert export(world, "glb", *args, "--output", str(tmp_path / "x")) == 0
        found: dict[str, float] = json.loads((tmp_path / "x" / "export.json").read_text())
        return found

    every = made()
    assert made("--mesh-edge", "4")["mesh_edge"] == 4 > every["mesh_edge"]
    assert made("--side", "16")["mesh_edge"] > every["mesh_edge"]
    assert made("--reach", "28.6")["vertices"] != every["vertices"], (
        "the model, hardly trained, shows haze at 28 to 29.3"
    )


def test_one_file_holds_one_look(world: World, tmp_path: Path) -> None:
    style = ["--references", str(world.references[0])]
    assert export(world, "glb", *style, "--output", str(tmp_path / "dusk.ply")) == 0
    assert len(trimesh.load(tmp_path / "dusk.ply").faces) > 100
    assert (
        export(
            world, "glb", *style, "--styles", f"x={world.references[1]}", "--output", str(tmp_path / "a.glb")
        )
        == 2
    )


@pytest.mark.parametrize("most", [50, 10_000])
def test_points_of_pixels_lie_where_the_view_sees_them_or_in_the_sky(world: World, most: int) -> None:
    trained = world.load()
    cameras = trained.cameras.select(torch.tensor(trained.known.train))
    every = render_maps(trained, cameras, side=32, reach=1e9, report=lambda done, total: None)
    reach = float(
        torch.cat([depth.flatten() for depth in every.depth]).median()
    )  # half of what is seen counts as sky
    maps = render_maps(trained, cameras, side=32, reach=reach, report=lambda done, total: None)
    points = seen_points(maps, most)
    sky = sum(int(depth.isinf().sum()) for depth in maps.depth)
    assert (
        len(points.position) == len(points.colour) == min(most, sum(depth.numel() for depth in maps.depth))
        and sky > 0
    )
    away = np.linalg.norm(points.position - cameras.pose[:, :, 3].mean(0).numpy(), axis=1)
    solid = np.linalg.norm(points.position[:, None] - cameras.pose[:, :, 3].numpy(), axis=2).min(1) < reach
    assert away[~solid].min() > 1.5 * away[solid].max() and (~solid).mean() == pytest.approx(
        sky / 6144, abs=0.2
    )


def test_splats_are_fitted_to_the_field(world: World, tmp_path: Path) -> None:
    """The longer they are trained the nearer they come to the field's render; a style has the same ones in
    other colours.
    """
    more = ["--references", str(world.references[1]), "--fit-cap", "500"]
    assert export(world, "ply", "--fit", "1e-6", "--fit-cap", "500", "--output", str(tmp_path / "begun")) == 0
    assert export(world, "ply", "splat", "spz", *more, "--fit", "0.08", "--output", str(tmp_path)) == 0
    trained = world.load()
    cameras = trained.known.cameras
    view = trained.known.test[0]
    shown = trained.render(cameras, view).rgb

    def quality(path: Path) -> float:
        capture = read_capture(path)
        return psnr(
            draw(capture.gaussians, camera_of(cameras, view), antialiased=capture.antialiased).image.clamp(
                0, 1
            ),
            shown,
        )

    assert quality(tmp_path / "splats.ply") > quality(tmp_path / "begun" / "splats.ply") + 1
    plain, snow = (read_capture(tmp_path / f"splats{look}.ply").gaussians for look in ("", ".snow"))
    assert (
        len(plain) <= 500 and torch.equal(plain.means, snow.means) and torch.equal(plain.logits, snow.logits)
    )
    assert float((plain.colours - snow.colours).abs().mean()) > 0.02
    assert len(read_capture(tmp_path / "splats.snow.splat").gaussians) == len(snow)
    # Widths are limited, or haze would be fitted by Gaussians that run away, beyond what .spz holds.
    centres = cameras.pose[:, :, 3]
    assert float((plain.means - centres.mean(0)).norm(dim=1).max()) < default_reach(trained.known.facts.space)
    assert len(read_capture(tmp_path / "splats.spz").gaussians) == len(plain)
