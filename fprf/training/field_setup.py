"""Before the first step of fields: encoders, features of all images, and what is found out from them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, NamedTuple

from torch import Tensor

from ..config import TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.config import FeatureTargets, TrainingPixels
from ..datamanagers.images import WHITE
from ..datamanagers.scene import ParsedScene
from ..errors import WeightsError
from ..interfaces import DataManager, Encoder
from ..io.cache import cache_folder
from ..rendering.space import Space
from .facts import Facts, FieldFacts
from .model import build_decoder
from .prepare import device_of, exposure_of, facts_of


class Prepared(NamedTuple):
    """A scene that is ready to be trained."""

    scene: ParsedScene
    manager: DataManager
    facts: Facts
    basis: Basis | None
    """Semantic basis; None without semantics."""


def build_encoders(config: TrainConfig, *, semantic: bool = True) -> tuple[Encoder, Encoder | None]:
    """The encoders of content and, where wanted and chosen, of semantics. Raises WeightsError with what
    either lacks.
    """
    built = list[Encoder | None]()
    missing = list[str]()
    for each in (config.content.encoder, config.semantic.encoder if semantic else None):
        try:
            built.append(None if each is None else each.build())
        except WeightsError as error:
            missing.append(str(error))
    if missing:
        raise WeightsError("; also ".join(missing))
    content, other = built
    assert content is not None
    return content, other


def prepare(
    config: TrainConfig,
    scene: ParsedScene,
    saved: Facts | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    *,
    space: Space | None = None,
    basis: Basis | None = None,
    seen: Callable[[int], Annotated[Tensor, "H W"]] | None = None,
) -> Prepared:
    """Everything of a scene of fields but the model, in a space that is found where none is given.

    Arguments as of `RunConfig.build`, `TrainingPixels` and `FeatureTargets`. Raises WeightsError where an encoder or a
    decoder lacks its weights.
    """
    device = device_of(config.device)
    content, semantic = build_encoders(config)
    content = content.to(device)
    semantic = None if semantic is None else semantic.to(device)
    build_decoder(
        config, encoder=content.identity, channels=content.channels
    )  # refused now, not after all the features
    background = config.render.background or (WHITE if scene.alpha else None)
    # Decodes all images and extracts their features, or finds both in the cache.
    manager = config.datamanager.build(
        TrainingPixels(scene=scene, seen=seen, background=background),
        FeatureTargets(content=content, semantic=semantic, dim=config.semantic.dim, basis=basis),
        cache=cache_folder("features"),
        seed=config.seed,
        progress=progress,
    )
    exposure = exposure_of(config.tones, scene, manager.image, saved)
    facts = facts_of(scene, background, space=space, exposure=exposure, poses=config.poses > 0)
    # Scales are the spread of the targets: losses in their units weigh the same with any encoder.
    contents = manager.content_store
    semantics = manager.semantic_store
    of_field = FieldFacts(
        channels=content.channels,
        dim=0 if semantics is None else semantics.channels,
        content_encoder=content.identity,
        semantic_encoder="" if semantic is None else semantic.identity,
        content_scale=1.0 if contents is None else contents.scale,
        semantic_scale=1.0 if semantics is None else semantics.scale,
    )
    facts = replace(facts, field=of_field)
    return Prepared(scene, manager, facts, None if semantics is None else semantics.basis)
