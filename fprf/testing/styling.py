"""Contracts of encoders, decoders and stylizers."""

# A plug-in is asked whether it is of an abstract kind.
# mypy: disable-error-code="type-abstract"

import torch
from torch import nn

from ..interfaces import Decoder, Encoder, Stylizer
from ..plugins.decoders.config import DecoderConfig
from ..plugins.encoders.config import EncoderConfig
from ..plugins.stylizers.config import StylizerConfig
from ..types import Want
from . import cases
from .configs import built
from .outputs import check_affine, check_needs, follows, pointwise, require, same, shares, tensor, trainable


def check_encoder(config: EncoderConfig) -> None:
    """Any size, any batch, frozen, deterministic, finite, and with an identity that is the same each time."""
    encoder, name = built(config, Encoder, config.build, again=False)
    require(not encoder.training, f"{name}: must be in evaluation mode")
    require(
        not any(p.requires_grad for p in encoder.parameters()),
        f"{name}: its parameters must not want gradients",
    )
    require(
        config.build().identity == encoder.identity, f"{name}: identity must be the same for the same config"
    )
    # Sizes that strides divide, and some that they do not; both ways round.
    for height, width in ((64, 96), (49, 37), (96, 64)):
        image = cases.uniform(2, 3, height, width, seed=18)
        features = encoder(image)
        tensor(features, (2, encoder.channels, None, None), f"{name} of {height} x {width} pixels")
        h, w = features.shape[2:]
        require(
            1 <= h <= height and 1 <= w <= width, f"{name}: {h} x {w} features of {height} x {width} pixels"
        )
        skew = (w / width) / (h / height)
        require(
            0.4 < skew < 2.5,
            f"{name}: {h} x {w} features do not keep the aspect of {height} x {width} pixels",
        )
        require(not features.requires_grad, f"{name}: features must not carry gradients to the weights")
        same(encoder(image), features, 0.0, f"{name}: must be deterministic")
        same(
            encoder(image[1:]),
            features[1:],
            1e-3,
            f"{name}: an image's features must not depend on its batch",
        )
        # Half of it cut out, and all of it.
        opaque = torch.ones(2, height, width)
        same(
            encoder.cutout(image, opaque),
            features,
            1e-3,
            f"{name}: what is opaque must have the features of the image",
        )
        for opacity in ((torch.arange(width) < width // 2).float() * opaque, 0 * opaque):
            shown = encoder.cutout(image * opacity[:, None], opacity)
            tensor(shown, tuple(features.shape), f"{name} of a picture that is transparent in places")
    # Photographs of a pixel, and slivers: nothing may be smaller than a kernel allows.
    for height, width in ((1, 1), (2, 90), (90, 2)):
        features = encoder(cases.uniform(1, 3, height, width, seed=19))
        tensor(features, (1, encoder.channels, None, None), f"{name} of {height} x {width} pixels")
    for level in (0.0, 1.0):
        tensor(
            encoder(torch.full((1, 3, 40, 40), level)),
            (1, encoder.channels, None, None),
            f"{name} of a flat image",
        )
    # In float64 a tensor that it makes for itself shows, if it does not follow the inputs.
    image = cases.uniform(1, 3, 40, 40, seed=20).double()
    encoder.double()
    follows(lambda: encoder(image), image, name)


def check_decoder(config: DecoderConfig, *, encoder: str, channels: int) -> None:
    """Colours in [0, 1], point by point. `encoder` is the identity of an encoder that it has weights for."""
    decoder, name = built(config, Decoder, lambda: config.build(encoder=encoder, channels=channels))
    content = torch.cat([cases.normal(9, channels, seed=21), cases.normal(9, channels, seed=12) * 1e3])
    tensor(decoder(content), (18, 3), name, low=0.0, high=1.0)
    pointwise(lambda points: decoder(points), content, name)
    trainable(decoder, decoder(content).sum(), name)
    decoder.double()
    content = content.double()
    follows(lambda: decoder(content), content, name)
    # Fields join the first of the layers with a map of their own, and never ask `forward`.
    if decoder.layers is not None:
        value = content
        for layer, (weight, bias) in enumerate(decoder.layers):
            value = nn.functional.linear(value.relu() if layer > 0 else value, weight, bias)
        same(torch.sigmoid(value), decoder(content), 1e-9, f"{name}: layers must be what forward does")


def check_stylizer(config: StylizerConfig) -> None:
    """Point by point, finite, honest about what it needs; its matches are shares of the style codes; affine
    in content unless the config carries colours over.
    """
    name = type(config).__name__

    def check(codes: int, regions: int, dims: int) -> None:
        dictionary = cases.dictionary(codes, 8, dims)
        scene = cases.scene(regions, 8, dims)
        stylizer = built(config, Stylizer, lambda: config.build(dictionary=dictionary, scene=scene))[0]
        check_needs(stylizer, f"{name}: needs")
        # Features on which nothing was fitted; semantics only where it says that it reads them.
        content = cases.normal(11, 8, seed=22)
        semantic = cases.normal(11, dims, seed=13)
        given = None
        if Want.SEMANTIC in stylizer.needs:
            given = semantic
        styled = stylizer(content, given)
        tensor(styled, (11, 8), name)
        same(stylizer(content, given), styled, 0.0, f"{name}: must be deterministic")
        # Views are restyled in chunks of any size, and none may show.
        for some in (slice(0, 4), slice(0, 0)):
            part = stylizer(content[some], None if given is None else given[some])
            same(part, styled[some], 1e-4, f"{name}: a point must not depend on the others")
        if config.colours <= 0:
            check_affine(stylizer, content, given, name)
        # Match maps and regions are drawn from shares of the style codes.
        shares(stylizer.match(semantic), (11, codes), f"{name}.match")
        shares(stylizer.region_match(scene.keys), (regions, codes), f"{name}.region_match")
        stylizer.double()
        wide = None if given is None else given.double()
        follows(lambda: stylizer(content.double(), wide), content.double(), name)
        follows(lambda: stylizer.match(semantic.double()), content.double(), f"{name}.match")

    # Several references, one flat picture, and a scene without semantics.
    for codes, regions, dims in ((5, 3, 4), (1, 1, 4), (2, 1, 0)):
        check(codes, regions, dims)
    if config.handles_allowed_references:
        # Two references, of which every region may take from the first alone.
        both = cases.dictionary(4, 8, 4)._replace(
            reference=torch.tensor([0, 0, 1, 1]), names=("one", "other")
        )
        pinned = both._replace(allowed=torch.tensor([[True, False]] * 3))
        match = config.build(dictionary=pinned, scene=cases.scene(3, 8, 4)).match(
            cases.normal(11, 4, seed=23)
        )
        taken = bool(match[:, 2:].any())
        require(
            not taken, f"{name}: handles_allowed_references is true, but codes that are not allowed are taken"
        )
