"""A package that brings a kind of scene: a textured plane, which every verb takes."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fake_packages import packages_in
from session_helpers import Listener, camera_of
from tiny_world import World

import fprf
from fprf.cli.main import main
from fprf.datamanagers.images import load_image
from fprf.io.images import to_uint8
from fprf.page.messages import ViewRequest
from fprf.page.session import Session, view_of_run
from fprf.training.loading import open_run
from fprf.training.quality import QualityConfig

PLANE = '''
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from fprf.run_config import RunConfig
from fprf.datamanagers.basis import Basis
from fprf.datamanagers.images import load_images
from fprf.interfaces import Figures, State
from fprf.plugins.encoders.config import RandomConfig
from fprf.rendering.cameras import grid_rays
from fprf.scenes import Scene, SceneLearner, SceneView
from fprf.splats.restyle import ColourEncoder
from fprf.style.dictionary import Encoders
from fprf.style.scene_style import scene_style
from fprf.training import checkpoint
from fprf.training.loading import LoadedRun
from fprf.training.prepare import facts_of
from fprf.types import View


@dataclass(frozen=True, kw_only=True)
class PlaneConfig(RunConfig):
    """A picture on the ground."""

    kind = "plane"
    steps: int = 20
    """Steps."""
    texels: int = 16
    """Texels a side."""

    def build(self, scene, device, *, saved=None, progress=None):
        return PlaneLearner(self, scene, device, saved)


def plane() -> PlaneConfig:
    """A picture on the ground, as a method."""
    return PlaneConfig()


class PlaneLearner(SceneLearner):
    def __init__(self, config, scene, device, saved):
        self.config, self._device = config, device
        self._facts = saved or facts_of(scene)
        self.plane = PlaneScene(torch.zeros(1, 3, config.texels, config.texels), scene.cameras, names=())
        self.images = [torch.from_numpy(image).float() / 255 for image in load_images(scene, None, scene.train.tolist())]
        self.views, self.error = scene.train.tolist(), 0.0

    device = property(lambda self: self._device)
    facts = property(lambda self: self._facts)

    def step(self, index, share):
        self.plane.texture.requires_grad_(True)
        k = index % len(self.views)
        loss = (self.plane.pixels(self.plane.cameras, self.views[k])[0] - self.images[k].reshape(-1, 3)).square().mean()
        gradient, = torch.autograd.grad(loss, self.plane.texture)
        with torch.no_grad():
            self.plane.texture.sub_(20 * gradient)
        self.plane.texture.requires_grad_(False)
        self.error, self.rays = float(loss.detach()), index

    def figures(self):
        return Figures({"rgb": self.error}, self.rays)

    def state(self):
        return State({"texture": self.plane.texture}, {})

    def load(self, state):
        self.plane.texture.copy_(state.model["texture"])


def open_plane(run, config, device, quality):
    saved, _ = checkpoint.load_latest(run.checkpoints)
    known = run.load_known()
    scene = PlaneScene(saved.model["texture"], known.cameras, known.names)
    return LoadedRun(run, run.load_config()[1], known, saved.step, saved.seconds, scene)


@dataclass(frozen=True, eq=False)
class PlaneScene(Scene):
    """Rays meet a picture a unit before each camera's own plane z = 0: the same for all views."""

    texture: object
    cameras: object = None
    names: tuple = ()
    look: object = None

    device = torch.device("cpu")
    decoder = None
    encoder = property(lambda self: RandomConfig(channels=4).build())
    semantic_encoder = property(lambda self: self.encoder.identity)

    def pixels(self, cameras, view):
        """Colours [R 3], distances [R] and texture coordinates [R 2] of all pixels of a view."""
        origin, direction = grid_rays(cameras, view)
        distance = 2 * origin.norm(dim=-1)
        place = ((origin + distance[:, None] * direction)[:, :2] / distance[:, None]).float()
        sampled = F.grid_sample(self.texture, place.view(1, -1, 1, 2), padding_mode="border", align_corners=False)
        return sampled[0, :, :, 0].T, distance.float(), place

    @torch.inference_mode()
    def render(self, cameras, view, *, resolution=None):
        colour, distance, place = self.pixels(cameras, view)
        if self.look is not None:
            colour = self.look.colour(lambda x: x, colour, self.semantic(colour))
        width, height = cameras.size[view].tolist()
        return View(colour.clamp(0, 1).view(height, width, 3), distance.view(height, width), torch.ones(height, width), 1.0)

    def semantic(self, colour):
        return torch.cat([colour, colour.mean(1, keepdim=True)], 1)

    def paint(self, cameras, view, pixel, values, *, semantic=True):
        colour, distance, _ = self.pixels(cameras, view)
        at = pixel.long()[:, 1] * int(cameras.size[view, 0]) + pixel.long()[:, 0]
        return values(self.semantic(colour[at])[:, : None if semantic else 0], None), torch.ones(len(at))

    def restyled(self, look):
        return replace(self, look=look)

    def cached(self, cameras, view):
        return PlaneView(self, cameras, view)

    def measured(self):
        colour = self.texture[0].flatten(1).T.clamp(0, 1)
        basis = Basis(torch.zeros(4), torch.eye(4))
        return scene_style(colour, self.semantic(colour), torch.ones(len(colour)), None, 3, 0), basis

    def encoders(self):
        return Encoders(ColourEncoder(), self.encoder, self.measured()[1], self.measured()[0], longest=64)


@dataclass(frozen=True, eq=False)
class PlaneView(SceneView):
    scene: PlaneScene
    cameras: object
    view: int

    def restyled(self, restyle=None):
        return self.scene.restyled(restyle).render(self.cameras, self.view)

    def paint(self, values):
        return values(self.scene.semantic(self.scene.pixels(self.cameras, self.view)[0]), None)
'''


def trained(world: World, folder: Path) -> Iterator[Path]:
    """Install the package and train a plane; its run folder."""
    with packages_in(folder / "site") as packages:
        points = {
            "fprf.methods": {"plane": "acme_plane:plane"},
            "fprf.scenes": {"plane": "acme_plane:open_plane"},
        }
        packages.install("acme-plane", points, code={"acme_plane": PLANE})
        assert (
            main(
                [
                    "train",
                    "plane",
                    "--data",
                    str(world.town),
                    "--output",
                    str(folder / "run"),
                    "--downscale",
                    "1",
                ]
            )
            == 0
        )
        yield folder / "run"


@pytest.fixture
def run(world: World, tmp_path: Path) -> Iterator[Path]:
    yield from trained(world, tmp_path)


def test_every_verb_takes_a_kind_of_scene_from_another_package(
    run: Path, world: World, tmp_path: Path
) -> None:
    dusk = ["--references", str(world.references[0])]
    assert main(["eval", str(run)]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert (
        metrics["method"] == "plane"
        and metrics["train_steps"] == 20
        and metrics["views"] == 2
        and metrics["psnr"] > 10
    )
    assert main(["stylize", str(run), *dusk, "--views", "0000", "--output", str(tmp_path / "dusk")]) == 0
    plain, styled = (
        load_image(next(folder.rglob("0000*.png"))) for folder in (run / "renders", tmp_path / "dusk")
    )
    assert styled.shape == plain.shape and abs(styled.astype(float) - plain.astype(float)).mean() > 3
    film = [
        "--path",
        "interpolate",
        "--frames",
        "2",
        "--show",
        "colour",
        "depth",
        "--output",
        str(tmp_path / "film"),
    ]
    assert main(["render", str(run), *dusk, *film]) == 0
    assert len(list((tmp_path / "film").glob("*.png"))) >= 2
    assert main(["gallery", str(run), *dusk, "--output", str(tmp_path / "page.html")]) == 0
    assert main(["export", str(run), "cameras", "--images", "--output", str(tmp_path / "files")]) == 0
    assert len(list((tmp_path / "files" / "images").glob("*.png"))) == 10
    assert fprf.load(run).render("0000").rgb.shape == (24, 32, 3)
    opened = open_run(run, "cpu", QualityConfig())
    client = Listener()
    with Session(replace(view_of_run(opened), pixels=32), client.post) as session:
        session.upload(world.references[0].read_bytes(), "dusk")
        session.handle("browser", ViewRequest(camera=camera_of(opened.scene, 0), captured=True))
        client.until(lambda: len(client.pictures("browser", "captured")) == 2)
    captured = to_uint8(opened.scene.render(opened.scene.cameras, 0).rgb).astype(float)
    assert abs(client.pictures("browser", "captured")[-1][..., ::-1] - captured).mean() < 3, "JPEG"
    assert abs(client.pictures("browser")[-1][..., ::-1] - captured).mean() > 3


def test_it_goes_on_like_any_other(run: Path, world: World, tmp_path: Path) -> None:
    assert main(["train", str(run / "config.json"), "--steps", "30"]) == 0
    words = [
        "--data",
        str(world.town),
        "--output",
        str(tmp_path / "once"),
        "--downscale",
        "1",
        "--steps",
        "30",
    ]
    assert main(["train", "plane", *words]) == 0
    resumed, once = (fprf.load(each).trained for each in (run, tmp_path / "once"))
    assert resumed.step == once.step == 30
    assert torch.equal(resumed.scene.texture, once.scene.texture)  # type: ignore[attr-defined]
    assert main(["eval", str(run), "--fit-poses"]) == 2
    assert main(["train", str(run / "config.json"), "--texels", "8"]) == 2


def test_a_run_of_a_kind_that_is_not_installed_is_named(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in trained(world, tmp_path):
        assert folder.is_dir()
    assert main(["eval", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "no plug-in 'plane' is installed" in error and "acme-plane 1" in error
