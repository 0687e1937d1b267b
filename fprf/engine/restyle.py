"""References to a stylizer: the feed-forward step, a second or less a photograph."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from ..errors import UsageError, WeightsError
from ..plugins.stylizers.config import StylizerConfig
from ..rendering.renderer import Restyle
from ..style.dictionary import StyleDictionary, build_dictionary
from ..style.references import read_reference
from ..style.scene import SceneStyle
from .loading import Trained, load_style
from .prepare import device_of

__all__ = ["Styled", "restyle"]


class Styled(NamedTuple):
    """A style on a scene."""

    restyle: Restyle
    dictionary: StyleDictionary
    scene: SceneStyle


@torch.inference_mode()
def restyle(
    trained: Trained,
    references: Sequence[Path],
    stylizer: StylizerConfig,
    *,
    strength: float = 1.0,
    weights: Sequence[float] = (),
    clusters: int = 10,
    blend: float = 0.3,
) -> Styled:
    """Build the dictionary of the references and the stylizer on the scene.

    Raises UsageError for no references or weights that do not match them, DataError for unreadable photographs, WeightsError
    where the encoders are not those that the scene was trained with.
    """
    if not references:
        raise UsageError("--references: at least one photograph is needed, for example --references autumn.jpg night.jpg")
    if weights and len(weights) != len(references):
        raise UsageError(f"--weights: {len(weights)} weights for {len(references)} references; give one each, or none")
    scene, basis = load_style(trained.run)
    config, facts = trained.config, trained.known.facts
    content = config.content.encoder.build()
    semantic = config.semantic.encoder.build() if config.semantic.encoder is not None and basis is not None else None
    for name, encoder, known in (("content", content, facts.content_encoder), ("semantic", semantic, facts.semantic_encoder)):
        if encoder is not None and encoder.identity != known:
            raise WeightsError(
                f"{name} encoder: the scene was trained with {known}, this is {encoder.identity}; "
                "use the same weights, or train the scene again"
            )
    longest = int(trained.known.cameras.size.amax())
    dictionary = build_dictionary(
        [
            read_reference(
                path,
                content=content,
                semantic=semantic,
                basis=basis,
                longest=max(longest, _SHORTEST),
                weight=weights[i] if weights else 1.0,
                guided=config.datamanager.guided,
            )
            for i, path in enumerate(references)
        ],
        clusters=clusters,
        blend=blend,
        seed=config.seed,
    )
    device = next(trained.model.parameters()).device
    built = stylizer.build(dictionary=dictionary, scene=scene).to(device_of(str(device)))
    return Styled(Restyle(built, strength), dictionary, scene)


_SHORTEST = 128
"""References are encoded at the scene's size, but not below this: clusters would have too few pixels."""
