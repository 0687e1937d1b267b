"""Runs in the middle of their training, whose parameters come from elsewhere: what `fprf train --view` shows."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from ..datamanagers.basis import Basis
from ..errors import CheckpointError
from ..interfaces import Scene
from ..style.references import Encoders
from . import tensorfiles
from .blocks import RAYS, built_block, folder_of, load_blocks
from .loading import Trained, encoders_of
from .model import build_model
from .prepare import device_of
from .run import Known, Run
from .style_pass import measure_style

_RAYS = 2**14
"""Rays that the style of an unfinished run is measured with: 0.2 s instead of seconds, and it changes soon."""


class UnfinishedRun(ABC):
    """A run whose config.json and scene.json are written."""

    run: Run
    known: Known

    @abstractmethod
    def scene(self, tensors: Mapping[str, Tensor]) -> Scene:
        """The scene with these parameters; what was returned before may change. Raises CheckpointError for those of another."""

    @abstractmethod
    def encoders(self, before: Encoders | None) -> Encoders:
        """Encoders with the style of the scene of now; those that were opened `before` are kept.

        Raises DataError where the scene still renders empty, NumericsError where its features are not finite.
        """


class UnfinishedFields(UnfinishedRun):
    """A run of fields, or a `block` of it in its surroundings. Raises CheckpointError where it has not begun."""

    def __init__(self, root: Path, device: str, block: int | None = None) -> None:
        self.run = Run(root)
        saved, method = self.run.load_config()
        config = saved.fields_only(root)
        self.known = self.run.load_known()
        if block is None:
            model = build_model(config, self.known.facts)
        else:
            views = tensorfiles.read(folder_of(root, block) / RAYS)["views"]
            model = built_block(root, config, self.known.facts, load_blocks(root), block, views).model
        model.requires_grad_(False)
        self.trained = Trained(self.run, config, method, self.known, model.to(device_of(device)).eval(), 0, 0.0)

    def scene(self, tensors: Mapping[str, Tensor]) -> Trained:
        try:
            self.trained.model.load_state_dict(dict(tensors))
        except RuntimeError as error:
            raise CheckpointError(f"{self.run.root}: its parameters are not those of its config ({error})") from error
        return self.trained

    def encoders(self, before: Encoders | None) -> Encoders:
        config = self.trained.config
        few = replace(config, statistics=replace(config.statistics, rays=min(_RAYS, config.statistics.rays)))
        style = measure_style(few, self.trained.model, self.known.cameras, torch.tensor(self.known.train))
        if before is not None:
            return before._replace(scene=style)
        basis = None if style.keys.shape[1] == 0 else Basis.from_tensors(self.run.load_tensors("basis"))
        return encoders_of(self.trained, style, basis)
