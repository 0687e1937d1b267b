"""A scene's networks together, built from a config and what was found out about the scene. No data, no
losses, no files.
"""

from functools import cached_property
from typing import Annotated

import torch
from torch import Tensor, nn

from ..blocks.fields import add_penalties
from ..config import TrainConfig
from ..errors import WeightsError
from ..interfaces import ContentField, Decoder, Parts, Sampler, SemanticField
from ..plugins.decoders.config import pretrain_line
from ..rendering.cameras import Cameras
from ..testing.outputs import check_parts
from .camera_optimizers import Poses, Tones, poses_of, tones_of
from .facts import Facts


def build_decoder(config: TrainConfig, *, encoder: str, channels: int) -> Decoder:
    """The decoder of the content encoder, by the encoder's identity.

    Raises WeightsError where there is none or it belongs to another encoder, with the line that makes the
    right one.
    """
    try:
        return config.content.decoder.build(encoder=encoder, channels=channels, seed=config.seed + 3)
    except WeightsError as error:
        line = pretrain_line(config.content.encoder)
        raise WeightsError(
            f"{error}; `{line}` makes its decoder, --content.decoder.weights FILE names it"
        ) from error


class Model(nn.Module):
    """Sampler, fields and decoder of one scene."""

    def __init__(self, parts: Parts, tones: Tones | None = None, poses: Poses | None = None) -> None:
        super().__init__()
        self.space = parts.space
        self.sampler = parts.sampler
        self.field = parts.field
        self.semantic = parts.semantic
        self.decoder = parts.decoder
        self.tones = tones
        self.poses = poses

    @property
    def parts(self) -> Parts:
        """The modules that the renderer needs."""
        return Parts(self.space, self.sampler, self.field, self.semantic, self.decoder)

    @property
    def device(self) -> torch.device:
        """The device of all parameters."""
        return next(self.parameters()).device

    def learned(self) -> list[nn.Parameter]:
        """Parameters that training moves, in a fixed order: everything but what decoders bring frozen."""
        found: list[nn.Parameter] = []
        for p in self.parameters():
            if p.requires_grad:
                found.append(p)
        return found

    def penalties(self) -> dict[str, Tensor]:
        """Regularisers of all parts by name; those of one name are added up."""
        # Members of blocks have added theirs up already.
        parts = (self.field, self.sampler, self.semantic)
        return add_penalties(part.penalties() for part in parts if part is not None)

    def refined(self, cameras: Cameras) -> Cameras:
        """The cameras of a capture where training has put them."""
        if self.poses is None:
            return cameras
        return self.poses.refined(cameras)

    @cached_property
    def penalty_names(self) -> frozenset[str]:
        """Names of `penalties`, which are computed once to find them."""
        with torch.no_grad():
            return frozenset(self.penalties())


def background_of(facts: Facts, device: torch.device) -> Annotated[Tensor, "3"] | None:
    """The background as a tensor."""
    if facts.background is None:
        return None
    return torch.tensor(facts.background, device=device)


def build_fields(config: TrainConfig, facts: Facts) -> tuple[Sampler, ContentField, SemanticField | None]:
    """Sampler, content and semantic field at their seeded start."""
    sampler = config.sampler.build(seed=config.seed)
    content = config.content.field.build(channels=facts.of_field.channels, seed=config.seed + 1)
    semantic = None
    if facts.of_field.dim:
        semantic = config.semantic.field.build(channels=facts.of_field.dim, seed=config.seed + 2)
    return sampler, content, semantic


def build_model(config: TrainConfig, facts: Facts) -> Model:
    """The model at its seeded start.

    Raises WeightsError where no decoder fits the content encoder, PluginError where a part breaks its
    contract at once.
    """
    of_field = facts.of_field
    decoder = build_decoder(config, encoder=of_field.content_encoder, channels=of_field.channels)
    parts = Parts(facts.space, *build_fields(config, facts), decoder)
    check_parts(config, parts, of_field.channels, of_field.dim)
    return Model(parts, tones_of(facts), poses_of(facts, config.poses))
