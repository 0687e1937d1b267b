"""Gaussians from photographs: that they learn, go on where they stopped, and come out as every verb says."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learning import STEPS, stepped
from splat_ball import equal
from torch import Tensor

import fprf
from fprf.blocks.config import BisectConfig, LayoutConfig, SingleConfig
from fprf.cli.main import main
from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import ParsedScene
from fprf.interfaces import State
from fprf.io.images import write_image
from fprf.ops.rasterise.rendering import lift
from fprf.ops.rasterise.training import LOG_SCALES, TrainableGaussians
from fprf.plugins.encoders.config import SEMANTICS, RandomConfig
from fprf.rendering.cameras import Cameras
from fprf.splats import photographs
from fprf.splats import setup as training
from fprf.splats.config import GaussiansConfig
from fprf.splats.drawing import draw
from fprf.splats.files import read_capture
from fprf.splats.gaussians import Gaussians, tensors_of
from fprf.splats.learner import Bounds, GaussianLearner
from fprf.splats.pinholes import camera_of
from fprf.splats.scene import SplatScene
from fprf.splats.setup import build
from fprf.splats.view_corrections import ViewCorrections
from fprf.training import checkpoint, driver
from fprf.training.camera_optimizers import Tones, moved_cameras
from fprf.training.loading import open_run


def test_it_goes_on_bit_for_bit(config: GaussiansConfig, scene: ParsedScene) -> None:
    asked = replace(config, tones=True, poses=1e-3)
    half, whole, again = (build(asked, scene) for _ in range(3))
    again.load(stepped(half, 0, 30).state())
    assert equal(stepped(again, 30, 60).gaussians(), stepped(whole, 0, 60).gaussians())


SECOND: dict[str, Any] = {
    "initial": 200, "cap": 500, "degree": 2, "ssim": 0.0, "coarse": 0.0, "grow": 0.9, "relocate_every": 30, "rate": 0.5,
    "surroundings": 0, "pixels_per_gaussian": 40,
    "background": (1.0, 0.0, 0.0), "seed": 1, "masks": False, "tones": True, "poses": 1e-3, "k1": 0.2,
}  # fmt: skip


@pytest.mark.parametrize("name", SECOND)
def test_every_field_changes_something(
    config: GaussiansConfig, scene: ParsedScene, tmp_path: Path, name: str
) -> None:
    if name == "masks":
        width, height = scene.cameras.size[0].tolist()
        write_image(tmp_path / "mask.png", np.zeros((height, width, 3), np.uint8))
        scene = replace(scene, masks=(tmp_path / "mask.png",) * len(scene.paths))
    end = STEPS if name in ("background", "cap", "grow", "relocate_every", "pixels_per_gaussian") else 3
    first, second = (
        stepped(build(each, each.calibrated(scene)), 0, end)
        for each in (config, replace(config, **{name: SECOND[name]}))
    )
    assert not equal(first.gaussians(), second.gaussians())


def test_a_view_without_numbers_changes_nothing(config: GaussiansConfig, scene: ParsedScene) -> None:
    learner = build(config, scene)
    before = learner.gaussians()
    for photograph in learner.levels[1].values():
        photograph.planes[:] = np.nan
    learner.step(0, 0.0)
    assert learner.figures()[2:5] == (1, 1, "the loss") and equal(learner.gaussians(), before)


def test_dark_surfaces_become_opaque(config: GaussiansConfig, scene: ParsedScene, tmp_path: Path) -> None:
    """Over black in every step a hole would be as good; photographs with transparency keep their holes."""
    width, height = scene.cameras.size[0].tolist()
    write_image(tmp_path / "black.png", np.zeros((height, width, 3), np.uint8))
    black = replace(scene, paths=(tmp_path / "black.png",) * len(scene.paths))
    holes = []
    for alpha in (False, True):
        found = stepped(build(config, replace(black, alpha=alpha))).gaussians()
        camera = camera_of(scene.cameras, int(scene.train[0]))
        holes.append(1 - float(draw(found, camera, antialiased=True).opacity.mean()))
    assert 20 * holes[0] < holes[1]


def test_colours_that_no_view_shows_fall_back_to_their_mean(
    config: GaussiansConfig, scene: ParsedScene
) -> None:
    """Else a Gaussian could have any colour from where it was not photographed, and a style would bring that
    into view.
    """
    learner = build(config, scene)
    start = learner.gaussians()
    faint = replace(
        start, logits=torch.full_like(start.logits, -20), harmonics=torch.ones_like(start.harmonics)
    )
    learner.start_from(faint)
    stepped(learner, 0, 100)
    after = learner.gaussians().harmonics
    assert torch.equal(after[:, 0], faint.harmonics[:, 0])
    assert (
        float(after[:, 1:].min())
        == float(after[:, 1:].max())
        == pytest.approx(math.exp(-0.06 * 3.96), abs=0.01)
    )


def test_a_gaussian_learns_alike_however_late_it_is_seen(config: GaussiansConfig, scene: ParsedScene) -> None:
    """Two views in opposite directions: what the second one shows moves as if nothing had been learnt
    before.
    """
    pose = scene.cameras.pose[0].clone()
    back = pose * torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=pose.dtype)
    cameras = replace(scene.cameras.select(torch.zeros(2, dtype=torch.int64)), pose=torch.stack([pose, back]))
    both = replace(scene, cameras=cameras, train=torch.arange(2))
    draws = np.random.default_rng(0)
    images = {view: draws.integers(0, 255, (24, 32, 3), np.uint8) for view in range(2)}
    levels = photographs.make_levels(both, images, {}, 0.01)
    spread, quaternions = (torch.from_numpy(draws.normal(size=(32, k))) for k in (3, 4))
    means = pose[:, 3] - torch.where(torch.arange(32) < 16, 4.0, -4.0)[:, None] * pose[:, 2] + 0.5 * spread
    harmonics = torch.zeros(32, (config.degree + 1) ** 2, 3)
    start = Gaussians(
        means.float(), quaternions.float(), torch.full((32, 3), -1.5), torch.zeros(32), harmonics
    )

    def learnt(order: list[int]) -> Tensor:
        learner = GaussianLearner(config, levels, Bounds(room=32, scene_scale=1.0))
        learner.start_from(start)
        rates = np.full(learner.model.rows, 0.01, np.float32)
        for view in order:
            learner.model.learn(levels[0][view], background=config.background, ssim=0.2, rates=rates)
        return torch.cat([part[16:].flatten() for part in vars(learner.gaussians()).values()])

    alone = learnt([1] * 3)
    assert not torch.equal(alone, learnt([]))
    assert torch.equal(learnt([0] * 40 + [1] * 3), alone)


def test_an_exposure_learns_alike_however_rarely_its_view_is_seen(
    config: GaussiansConfig, scene: ParsedScene
) -> None:
    """Nothing lies in view, so a render is the background times the factor; all photographs but one are of
    that colour.
    """
    many = 40
    same = replace(
        scene, cameras=scene.cameras.select(torch.zeros(many, dtype=torch.int64)), train=torch.arange(many)
    )
    grey = replace(config, background=(0.4, 0.4, 0.4))
    images = {view: np.full((24, 32, 3), 204 if view == 0 else 102, np.uint8) for view in range(many)}
    camera = scene.cameras.pose[0]
    behind = (camera[:, 3] + 5 * camera[:, 2]).float().expand(16, 3)
    nothing = Gaussians(
        behind, torch.ones(16, 4), torch.full((16, 3), -3.0), torch.zeros(16), torch.zeros(16, 9, 3)
    )

    def gain(views: int) -> Tensor:
        tones = Tones(torch.zeros(many), ())
        levels = photographs.make_levels(replace(same, train=torch.arange(views)), images, {}, 0.01)
        learner = GaussianLearner(
            replace(grey, degree=2),
            levels,
            Bounds(room=16, scene_scale=1.0),
            corrections=ViewCorrections(tones),
        )
        learner.start_from(nothing)
        for step in range(3 * views):
            learner.step(step, 0.0)
            assert not learner.failed
        return tones.gain.detach()

    often = gain(1)
    rarely = gain(many)
    assert (often[0] > 0.01).all()
    torch.testing.assert_close(rarely[0], often[0], rtol=0.1, atol=0)  # apart by the mean of all, which stays


def test_tones_are_told_from_the_scene(config: GaussiansConfig, scene: ParsedScene) -> None:
    """Photographs that were taken darker or warmer: factors are found up to their mean."""
    asked = replace(
        config, tones=True, ssim=0.0
    )  # what SSIM keeps of the targets would be that of the others
    learner = build(asked, scene)
    wanted = torch.linspace(-0.3, 0.3, len(scene.paths))[:, None] * torch.tensor([1.0, 0.5, -0.5])
    for level in learner.levels:
        for view, target in level.items():
            target.planes[: 3 * target.area].reshape(3, target.area)[:] *= wanted[view].exp().numpy()[:, None]
    stepped(learner)
    train = scene.train
    assert learner.corrections.tones is not None
    found = learner.corrections.tones(train).log().detach()
    assert float(found.mean(0).abs().max()) < 1e-5
    true = wanted[train] - wanted[train].mean(0)
    assert float((found - true).square().mean()) < 0.75 * float(true.square().mean())


def test_poses_that_are_off_are_found(config: GaussiansConfig, scene: ParsedScene) -> None:
    """Training views were turned by three degrees: refined, they come back, up to what turns all of them
    alike.
    """
    draw = torch.Generator().manual_seed(0)
    turn = math.radians(3) * torch.nn.functional.normalize(
        torch.randn(len(scene.paths), 3, generator=draw).double(), dim=1
    )
    turn[scene.test] = 0
    moves = torch.cat([turn, torch.zeros_like(turn)], 1)
    off = replace(scene, cameras=moved_cameras(scene.cameras, moves))
    learner = stepped(build(replace(config, poses=5e-3), off))
    assert learner.corrections.poses is not None
    found = learner.corrections.poses.refined(off.cameras)
    assert torch.equal(found.pose[scene.test], scene.cameras.pose[scene.test])

    def error(cameras: Cameras) -> float:
        apart = (cameras.pose[:, :, :3].transpose(1, 2) @ scene.cameras.pose[:, :, :3])[scene.train]
        skew = (apart - apart.transpose(1, 2))[:, (2, 0, 1), (1, 2, 0)] / 2
        return float((skew - skew.mean(0)).norm())

    assert error(found) < 0.6 * error(off.cameras)


def test_nothing_floats_before_a_sky_that_is_masked(
    config: GaussiansConfig, scene: ParsedScene, tmp_path: Path
) -> None:
    above = np.zeros((24, 32, 3), np.uint8)
    above[:8] = 255
    write_image(tmp_path / "sky.png", above)
    masked = replace(scene, sky_masks=(tmp_path / "sky.png",) * len(scene.paths))
    centre = scene.cameras.pose[scene.train][:, :, 3].mean(0).float()

    def before_the_sky(masks: bool) -> float:
        """Weight of all but the surroundings in the upper third of the views."""
        found = stepped(build(replace(config, masks=masks), masked)).gaussians()
        sky = torch.from_numpy(above[..., :1] / 255).float()
        seen = torch.zeros(len(found), 1)
        for view in scene.train.tolist():
            seen += lift(
                *list(vars(found).values())[:4], camera_of(scene.cameras, view), sky, antialiased=True
            )
        distance = (found.means - centre).norm(dim=1)
        return float(seen[distance < 0.4 * distance.max()].sum())

    assert before_the_sky(True) < 0.5 * before_the_sky(False)


def command(config: GaussiansConfig, run: Path) -> list[str]:
    """Words that train the town."""
    small = ["--initial", "300", "--cap", "400", "--steps", "40"]
    return ["train", "fprf-splats", "--data", str(config.data), *small, "--output", str(run)]


@pytest.fixture(scope="module")
def run(config: GaussiansConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("splats") / "run"
    assert main(command(config, root)) == 0
    return root


def test_verbs_of_a_run(run: Path, tmp_path: Path) -> None:
    assert main(["eval", str(run)]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["method"] == "fprf-splats" and metrics["train_steps"] == 40 and metrics["psnr"] > 10
    assert len([*(run / "renders" / "test").glob("*.png")]) == metrics["views"]
    assert (
        main(
            [
                "render",
                str(run),
                "--path",
                "dataset",
                "--show",
                "colour",
                "depth",
                "--output",
                str(tmp_path / "film"),
            ]
        )
        == 0
    )
    assert len([*(tmp_path / "film").glob("*.png")]) == 10
    assert main(["eval", str(run), "--fit-poses"]) == 0
    fitted = json.loads((run / "metrics.json").read_text())
    assert (
        len(fitted["fitted_poses"]) == fitted["views"]
        and fitted["psnr_fitted_poses"] > fitted["psnr"] == metrics["psnr"]
    )
    assert main(["export", str(run), "--side", "64"]) == 0
    assert {f"mesh.{ending}" for ending in ("ply", "glb")} <= {
        path.name for path in (run / "exports").iterdir()
    }
    capture = read_capture(run / "exports" / "splats.ply")
    assert len(capture.gaussians) == metrics["gaussians"] and capture.antialiased
    assert main(["export", str(run), "cameras", "ply", "--images", "--output", str(tmp_path / "files")]) == 0
    again = parse_scene(tmp_path / "files", 1, None)
    assert (
        torch.allclose(again.cameras.pose, fprf.load(run).cameras.pose)
        and (tmp_path / "files" / "splats.ply").is_file()
    )
    # A run that is done goes on doing nothing, also where other semantics are asked for.
    before = (run / "checkpoints" / "step-0000040" / "manifest.json").read_bytes()
    assert main(["train", str(run / "config.json")]) == 0
    shutil.copytree(run, tmp_path / "other")
    words = [
        "--semantic.encoder",
        "random",
        "--semantic.encoder.channels",
        "6",
        "--regions",
        "3",
        "--semantic-size",
        "32",
    ]
    assert main(["train", str(tmp_path / "other" / "config.json"), *words]) == 0
    for folder in (run, tmp_path / "other"):
        assert (folder / "checkpoints" / "step-0000040" / "manifest.json").read_bytes() == before
    plain, other = (open_run(folder, "cpu").scene for folder in (run, tmp_path / "other"))
    assert plain.semantic_encoder == SEMANTICS.build().identity and len(plain.measured()[0].share) > 3
    # Small photographs are looked at enlarged, twice at most, and never above what was asked for.
    assert plain.longest == 2 * int(plain.cameras.size.amax()) and other.longest == 32
    encoder = RandomConfig(channels=6).build().identity
    assert (
        other.semantic_encoder == other.encoders().semantic.identity == encoder
        and len(other.measured()[0].share) == 3
    )
    assert (
        main(
            [
                "train",
                str(run / "config.json"),
                "--semantic.encoder",
                "vgg19",
                "--semantic.encoder.weights",
                "no.pth",
            ]
        )
        == 2
    )


def test_training_is_watched_and_changes_no_bit(
    run: Path, config: GaussiansConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While somebody looks there are checkpoints all the time, each a scene that takes a style."""
    monkeypatch.setattr(driver, "REPORT_SECONDS", 0.0)
    monkeypatch.setattr(driver, "_MIN_PAUSE", 0.0)
    monkeypatch.setattr(driver, "_SAVING_SHARE", 1e9)
    seen: list[tuple[int, int]] = []
    plain = GaussianLearner.step

    def step(learner: GaussianLearner, index: int, share: float) -> None:
        driver.watch(tmp_path / "run")
        if index == 30:
            opened = open_run(tmp_path / "run", "cpu")
            seen.append((opened.step, len(opened.scene.encoders().scene_style.share)))
        plain(learner, index, share)

    monkeypatch.setattr(GaussianLearner, "step", step)
    assert main(command(config, tmp_path / "run")) == 0
    assert seen[0][0] == 30 and seen[0][1] > 3
    alone, watched = (checkpoint.load_latest(each / "checkpoints")[0] for each in (run, tmp_path / "run"))
    assert alone is not None and watched is not None
    assert all(torch.equal(tensor, watched.model[name]) for name, tensor in alone.model.items())


def test_styles_on_a_run(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, colour in (("dusk", (40, 30, 120)), ("snow", (230, 235, 240))):
        noise = np.random.default_rng(0).integers(-20, 20, (96, 128, 3))
        write_image(tmp_path / f"{name}.png", (np.array(colour) + noise).clip(0, 255).astype(np.uint8))
    dusk, snow = (str(tmp_path / f"{name}.png") for name in ("dusk", "snow"))
    known = json.loads((run / "scene.json").read_text())
    view = known["names"][known["test"][0]]
    both = ["--references", dusk, snow]

    def made(verb: str, name: str, *flags: str) -> Path:
        """What a verb writes of the run."""
        assert main([verb, str(run), *flags, "--output", str(tmp_path / name)]) == 0
        return tmp_path / name

    def stylized(name: str, *flags: str) -> np.ndarray[Any, Any]:
        return load_image(made("stylize", name, *flags, "--split", "test") / f"{view}.png")

    image = stylized("both", *both)
    names = {path.name for path in (tmp_path / "both").iterdir()}
    assert {f"{view}.png", f"{view}-match.png", "style.json", "dictionary.safetensors"} <= names
    kept = (run / "style.safetensors").read_bytes()
    # A style file on the same scene is the same style, pins and all.
    pinned = stylized("pinned", *both, "--pin", "0=snow.png")
    again = stylized("again", "--style", str(tmp_path / "pinned" / "style.json"))
    assert np.array_equal(pinned, again) and not np.array_equal(image, pinned)
    assert (run / "style.safetensors").read_bytes() == kept
    dataset = ["--path", "dataset", "--split", "test", "--show", "colour"]
    film = made("render", "film", *dataset, "match", *both, "--styles", "plain")
    assert np.array_equal(load_image(film / f"{view}.png")[:, : image.shape[1]], image)
    explained = made("stylize", "explained", *both, "--split", "test", "--explain", "true")
    assert "seen best at" in capsys.readouterr().out and (explained / "explain.png").is_file()
    made("gallery", "page.html", *both)
    keys = [{"frame": 0, "style": None}, {"frame": 3, "style": str(tmp_path / "both" / "style.json")}]
    (tmp_path / "keys.json").write_text(json.dumps({"format": 1, "keyframes": keys}))
    made("render", "keyed", *dataset, "--keyframes", str(tmp_path / "keys.json"))
    # A look that is held is one scene, whose Gaussians are recoloured once.
    (tmp_path / "held.json").write_text(json.dumps({"format": 1, "keyframes": [keys[1] | {"frame": 0}]}))
    scenes = []
    restyled = SplatScene.restyled
    monkeypatch.setattr(
        SplatScene, "restyled", lambda scene, look: scenes.append(look) or restyled(scene, look)
    )
    held = made(
        "render", "held", "--path", "orbit", "--frames", "3", "--keyframes", str(tmp_path / "held.json")
    )
    assert len(scenes) == 1 and len([*held.glob("*.png")]) == 3
    files = made("export", "files", "ply", "--references", snow)
    plain, styled = (read_capture(files / f"splats{name}.ply").gaussians for name in ("", ".snow"))
    assert torch.equal(plain.means, styled.means) and styled.colours.mean() > plain.colours.mean() + 0.05
    assert np.array_equal(fprf.load(run).stylize([dusk, snow]).render(view).pixels, image)


@pytest.mark.parametrize(
    ("line", "refused"),
    [
        ("export RUN splat --fit 1", "--fit"),
        ("export RUN cameras --output x.ply", "--output"),
        ("render RUN --tone 1", "tone"),
        ("stylize RUN --references PHOTO --max-memory 2", "--max-memory"),
        ("train fprf-splats --degree 4", "--degree"),
    ],
)
def test_what_gaussians_do_not_know_is_refused_in_one_line(
    run: Path, photograph: Path, line: str, refused: str, capsys: pytest.CaptureFixture[str]
) -> None:
    known = {"RUN": str(run), "PHOTO": str(photograph)}
    assert main([known.get(word, word) for word in line.split()]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    (error,) = [text for text in told if text.startswith("error: ")]
    assert error.startswith(f"error: {refused}")


def after_a_step_of_wide_ones(
    config: GaussiansConfig, scene: ParsedScene, restored: bool = False
) -> tuple[Tensor, Tensor]:
    """Means of the first Gaussians, and their widths after a step that begins with 3000 times as wide
    ones.
    """
    learner = build(config, scene)
    before = learner.gaussians()
    for each in (learner, build(config, scene) if restored else learner):
        wide = tensors_of(replace(before, log_scales=before.log_scales + 8.0), each.bounds.near)
        moments = learner.state().optimizer
        learner = each
        learner.load(State(wide, moments))
    learner.step(0, 0.0)
    assert not learner.failed
    return before.means, learner.gaussians().log_scales.exp()


@pytest.mark.parametrize("restored", [False, True])
def test_surroundings_do_not_reach_the_cameras(
    config: GaussiansConfig, scene: ParsedScene, restored: bool
) -> None:
    """However wide one becomes, it is cut to a fifth of its distance: from beside, it would be drawn before
    the scene.
    """
    before, widths = after_a_step_of_wide_ones(config, scene, restored)
    distance = before.norm(dim=1, keepdim=True)
    far = distance[:, 0] > 0.5 * distance.max()
    assert far.sum() == config.surroundings and (widths[far] <= 0.22 * distance[far]).all()


@pytest.mark.parametrize(("cells", "share"), [(SingleConfig(), 0.5), (BisectConfig(), 0.25)])
def test_nothing_covers_a_camera(
    config: GaussiansConfig, scene: ParsedScene, cells: LayoutConfig, share: float
) -> None:
    before, widths = after_a_step_of_wide_ones(replace(config, cells=cells, surroundings=0), scene)
    near = torch.cdist(before, scene.cameras.pose[scene.train][:, :, 3].float()).amin(1)[:, None]
    assert (widths <= 1.04 * share * near).all() and (widths > 0.8 * share * near).any()


@pytest.mark.parametrize("spread", [0.1, 3.0, 100.0])
def test_the_nearest_of_many_cameras_is_found(scene: ParsedScene, spread: float) -> None:
    draws = torch.Generator().manual_seed(0)
    cameras = scene.cameras.select(torch.zeros(400, dtype=torch.int64))
    centre = 10 * torch.randn(400, 3, generator=draws, dtype=torch.float64)
    cameras = replace(cameras, pose=torch.cat([cameras.pose[:, :, :3], centre[:, :, None]], 2))
    means = 10 * torch.randn(60, 3, 1, generator=draws) + spread * torch.randn(60, 3, 16, generator=draws)
    means = means.transpose(1, 2).reshape(-1, 3)
    gaussians = TrainableGaussians(len(means), bands=1)
    gaussians.start(torch.cat([means, torch.full((len(means), 11), 20.0)], 1).numpy())
    training.limit_widths(replace(scene, cameras=cameras, train=torch.arange(0, 400, 2)), 1e-3, cells=True)(
        gaussians, 0
    )
    widest = gaussians.read(LOG_SCALES)
    apart = (means[:, None].double() - centre[::2]).norm(dim=2).amin(1, keepdim=True)
    # Roundings of coordinates to float32, and of the logarithm.
    allowed = (4 * means.abs().max() + 16 * apart) * torch.finfo(torch.float32).eps
    assert ((torch.from_numpy(widest).double().exp() / 0.25 - apart).abs() <= allowed).all()


def test_blurred_views_are_shown_in_every_eighth_epoch_alone(
    config: GaussiansConfig, scene: ParsedScene
) -> None:
    images = {view: np.zeros((24, 32, 3), np.uint8) for view in scene.train.tolist()}
    level = photographs.make_levels(scene, images, {}, 0.01)[0]
    views = len(level)
    learner = GaussianLearner(config, [level], Bounds(room=32, scene_scale=1.0))

    def shown(steps: range) -> list[int]:
        return [learner._view(level, step) for step in steps]

    # None is blurred: each epoch is a permutation of all.
    assert all(sorted(shown(range(e * views, (e + 1) * views))) == sorted(level) for e in range(9))
    level.blurred = frozenset(list(level)[:2])
    sharp = views - 2
    cycle = views + 7 * (views - 2)
    for begin in (0, cycle):
        assert sorted(shown(range(begin, begin + views))) == sorted(level)
        for epoch in range(7):
            first = begin + views + epoch * sharp
            assert sorted(shown(range(first, first + sharp))) == sorted(set(level) - level.blurred)
