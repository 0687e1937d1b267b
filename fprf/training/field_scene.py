"""A trained run of fields, ready to render; blocks of a large scene are fetched as they are met."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..config import TrainConfig, fields_only
from ..datamanagers.basis import Basis
from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError, WeightsError
from ..interfaces import Decoder
from ..rendering.cameras import Cameras
from ..rendering.north import North
from ..scenes import Scene, Values
from ..style.dictionary import Encoders
from ..style.look import Restyle
from ..style.scene_style import SceneStyle, from_tensors
from ..types import Origin, View
from . import checkpoint
from .blocks import load_blocked
from .field_setup import build_encoders
from .locks import in_training
from .model import Model, build_model
from .prepare import device_of, reach_of
from .run import Known, Run
from .style_pass import measure_style
from .views import CachedView, cache_view, fit_pose, paint_pixels, render_view

_FEW_RAYS = 2**14
"""Rays that the style of a run in training is measured with: 0.2 s instead of seconds, and it changes
soon.
"""


@dataclass(frozen=True, eq=False)
class Trained(Scene):
    """A run of fields in memory."""

    run: Run
    config: TrainConfig
    method: str
    known: Known
    model: Model
    step: int
    seconds: float
    """Training time."""
    look: Restyle | None = None
    """Look that it is rendered in; None = as it was captured."""

    @property
    def names(self) -> tuple[str, ...]:
        return self.known.names

    @property
    def cameras(self) -> Cameras:
        """Cameras of the captured views, where training has put them."""
        return self.known.cameras

    @property
    def origin(self) -> Origin:
        return self.known.facts.origin

    @property
    def up(self) -> tuple[float, float, float] | None:
        return self.known.facts.up

    @property
    def north(self) -> North | None:
        return self.known.facts.north

    @property
    def device(self) -> torch.device:
        return self.model.device

    @property
    def semantic_encoder(self) -> str:
        """Identity of the encoder that the run was trained with."""
        return self.known.facts.of_field.semantic_encoder

    def render(self, cameras: Cameras, view: int, *, resolution: float | None = None) -> View:
        if resolution is None:
            config = self.config.render
        else:
            config = replace(self.config.render, resolution=resolution)
        return render_view(self.model, self.known.facts, cameras, view, config, self.look)

    def paint(
        self,
        cameras: Cameras,
        view: int,
        pixel: Annotated[Tensor, "R 2"],
        values: Values,
        *,
        semantic: bool = True,
    ) -> tuple[Annotated[Tensor, "R X"], Annotated[Tensor, "R"]]:
        """March; neither content nor colour is computed."""
        return paint_pixels(self.model, cameras, view, pixel, self.config.render, values, semantic=semantic)

    def restyled(self, look: Restyle | None) -> "Trained":
        return replace(self, look=look)

    def as_taken(self, view: int) -> "Trained":
        if self.model.tones is None:
            return self
        # Of a view that was held out, what its exposure says.
        red, green, blue = self.model.tones(torch.tensor([view]))[0].tolist()
        return replace(
            self, config=replace(self.config, render=replace(self.config.render, tone=(red, green, blue)))
        )

    def fit_poses(
        self, captured: ParsedScene, views: Sequence[int], progress: Callable[[int, int, str], None]
    ) -> Annotated[Tensor, "V 6"]:
        facts = self.known.facts
        moves = torch.zeros(len(self.names), 6, dtype=torch.float64)
        # Shifts are counted in what views commonly see, as in training, where poses are learnt.
        if facts.centres:
            reach = facts.reach
        else:
            reach = reach_of(captured, facts.space)
        for done, view in enumerate(views):
            progress(done, len(views), "fitting poses")
            photograph = self.known.photograph(captured, view, masks=self.config.reading.masks)
            budget = self.config.render.budget
            moves[view] = fit_pose(
                self.model, facts, self.cameras, view, photograph, reach=reach, budget=budget
            )
        progress(len(views), len(views), "fitting poses")
        return moves

    def cached(self, cameras: Cameras, view: int) -> CachedView:
        """A view with its geometry and features, as it was captured."""
        return cache_view(self.model, self.known.facts, cameras, view, self.config.render)

    @property
    def decoder(self) -> Decoder:
        return self.model.decoder

    def measured(self) -> tuple[SceneStyle, Basis | None]:
        """Statistics as training has written them; while it goes on those of now, from few rays."""
        if in_training(self.run.root) or not (self.run.root / "style.safetensors").is_file():
            # What changes soon need not be measured exactly.
            few = replace(self.config.statistics, rays=min(_FEW_RAYS, self.config.statistics.rays))
            style = measure_style(
                replace(self.config, statistics=few),
                self.model,
                self.known.cameras,
                torch.tensor(self.known.train),
            )
            return style, None if style.keys.shape[1] == 0 else Basis.from_tensors(
                self.run.load_tensors("basis")
            )
        return load_style(self.run)

    @torch.inference_mode()
    def encoders(self) -> Encoders:
        """The encoders that the scene was trained with. Raises WeightsError where those at hand are
        others.
        """
        (style, basis) = self.measured()
        config = self.config
        facts = self.known.facts
        content, semantic = build_encoders(config, semantic=basis is not None)
        # Features of another encoder would mean something else: references and scene must speak of the same.
        trained_with = (
            ("content", content, facts.of_field.content_encoder),
            ("semantic", semantic, facts.of_field.semantic_encoder),
        )
        for name, encoder, known in trained_with:
            if encoder is not None and encoder.identity != known:
                raise WeightsError(
                    f"{name} encoder: the scene was trained with {known}, this is {encoder.identity}; "
                    "use the same weights, or train the scene again"
                )
        device = self.device
        longest = int(self.cameras.size.amax())
        moved = None if semantic is None else semantic.to(device)
        return Encoders(
            content.to(device), moved, basis, style, device, longest, config.datamanager.guided, config.seed
        )


def load_run(root: Path, device: str = "auto", max_memory: float | None = None) -> Trained:
    """Rebuild a run's model from its folder alone. Raises CheckpointError with what is missing and what to
    do.

    Blocks of a large scene are fetched as they are met; at most `max_memory` MiB of them stay (one at least).
    """
    run = Run(root)
    saved_config, method = run.load_config()
    config = fields_only(saved_config, root)
    known = run.load_known()
    if known.facts.space.kind == "open":
        # Blocks: their space has no cube of its own, each brings one.
        model, step, seconds = load_blocked(root, config, known.facts, device_of(device), max_memory)
    else:
        saved, _ = checkpoint.load_latest(run.checkpoints)
        if saved is None:
            raise CheckpointError(
                f"{root}: no checkpoint yet; go on with `fprf train {root / 'config.json'} --output {root}`"
            )
        model = build_model(config, known.facts)
        step = saved.step
        seconds = saved.seconds
        checkpoint.restore(saved.state, model, None)
        model = model.requires_grad_(False).to(device_of(device)).eval()
    return Trained(
        run, config, method, replace(known, cameras=model.refined(known.cameras)), model, step, seconds
    )


def load_style(run: Run) -> tuple[SceneStyle, Basis | None]:
    """The scene's own statistics, and its semantic basis (None without semantics)."""
    scene = from_tensors(run.load_tensors("style"))
    if scene.keys.shape[1] == 0:
        return scene, None
    return scene, Basis.from_tensors(run.load_tensors("basis"))
