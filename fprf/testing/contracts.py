"""Contracts of plug-ins, as functions that a plug-in's own tests call: `check_encoder(MyConfig())`.

Each builds the plug-in from its config, as the program does, and raises AssertionError with one sentence on
the first breach. They take a second or so on a CPU and need no data but what is passed to them.
"""

# A plug-in is asked whether it is of an abstract kind.
# mypy: disable-error-code="type-abstract"

import dataclasses
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import nn

from ..blocks import routing
from ..blocks.config import LayoutConfig
from ..datamanagers.config import DataManagerConfig, FeatureTargets, TrainingPixels
from ..datamanagers.parsers.config import DataParserConfig
from ..errors import DataError
from ..fields.config import ContentFieldConfig, SemanticFieldConfig
from ..interfaces import (
    BlockLayout,
    ContentField,
    DataManager,
    DataParser,
    Decoder,
    Encoder,
    Executor,
    LossTerm,
    Sampler,
    SemanticField,
    Stylizer,
)
from ..ops.harmonics import HARMONIC
from ..plugins.codec import from_json, to_json
from ..plugins.config import Need, PluginConfig
from ..plugins.decoders.config import DecoderConfig
from ..plugins.decoders.decoders import MlpDecoder
from ..plugins.encoders.config import EncoderConfig, RandomConfig
from ..plugins.executors.config import ExecutorConfig
from ..plugins.losses.config import LossTermConfig
from ..plugins.samplers.config import SamplerConfig
from ..plugins.stylizers.config import StylizerConfig
from ..rendering.renderer import TrainingStep, render_rays
from ..types import Batch, Rays, Rendered, Sampled, Want
from . import cases
from .outputs import (
    Unread,
    check_affine,
    check_needs,
    close,
    follows,
    penalties,
    pointwise,
    require,
    same,
    shares,
    tensor,
    trainable,
)

if TYPE_CHECKING:
    from ..splats.files.base import CaptureFormat

Kind = TypeVar("Kind")


def check_config(config: PluginConfig) -> None:
    """A frozen dataclass that its defaults build, that compares by value, and that JSON carries there and
    back.
    """
    kind = type(config)
    parameters = getattr(kind, "__dataclass_params__", None)
    require(
        parameters is not None and parameters.frozen,
        f"{kind.__name__}: must be a dataclass(frozen=True, kw_only=True)",
    )
    require(kind() == kind(), f"{kind.__name__}: two with the same values must be equal")
    require(from_json(to_json(config), kind) == config, f"{kind.__name__}: must survive JSON unchanged")
    for field in dataclasses.fields(kind):
        require(
            field.name not in ("type", "build", "needs"),
            f"{kind.__name__}: a field must not be called {field.name!r}",
        )
        require(field.kw_only is True, f"{kind.__name__}.{field.name}: fields must be keyword-only")
    require(
        all(type(need) is Need for need in config.needs()),
        f"{kind.__name__}: needs() must give Need, as often as it is asked",
    )


def _built(
    config: PluginConfig, kind: type[Kind], build: Callable[[], object], *, again: bool = True
) -> tuple[Kind, str]:
    """The plug-in of a config that keeps to the rules of configs, and the name that sentences about it begin
    with.

    `again` builds it twice, to see that its parameters come from the seed.
    """
    check_config(config)
    made = build()
    name = type(config).__name__
    require(
        isinstance(made, kind),
        f"{name}: build() gives {type(made).__name__}, not an fprf.interfaces.{kind.__name__}",
    )
    assert isinstance(made, kind)
    module: object = made
    other = None
    if again and isinstance(module, nn.Module):
        other = build()
    if isinstance(module, nn.Module) and isinstance(other, nn.Module):
        mine = module.state_dict()
        theirs = other.state_dict()
        equal = mine.keys() == theirs.keys() and all(torch.equal(mine[key], theirs[key]) for key in mine)
        require(equal, f"{name}: its parameters must be drawn from the seed alone")
    return made, name


def check_encoder(config: EncoderConfig) -> None:
    """Any size, any batch, frozen, deterministic, finite, and with an identity that is the same each time."""
    encoder, name = _built(config, Encoder, config.build, again=False)
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
    decoder, name = _built(config, Decoder, lambda: config.build(encoder=encoder, channels=channels))
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
        stylizer = _built(config, Stylizer, lambda: config.build(dictionary=dictionary, scene=scene))[0]
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


def check_sampler(config: SamplerConfig) -> None:
    """Sorted edges between near and far, the same without a generator and with one of the same seed."""
    sampler, name = _built(config, Sampler, lambda: config.build(seed=0))

    def sample(rays: Rays, seed: int | None) -> Sampled:
        generator = None
        if seed is not None:
            generator = torch.Generator().manual_seed(seed)
        found: Sampled = sampler(
            rays, space=cases.space(), step=None if seed is None else 10, generator=generator
        )
        return found

    # Views sample without a generator, training with one; a chunk may hold any number of rays.
    for count in (6, 1, 0):
        rays = cases.rays(count)
        for seed in (None, 3):
            sampled = sample(rays, seed)
            again = sample(rays, seed)
            require(
                sampled.t.shape[0] == count and sampled.t.shape[1] >= 2,
                f"{name}: t must be [R E], E = samples + 1",
            )
            tensor(sampled.s, tuple(sampled.t.shape), f"{name}: s")
            tensor(sampled.t, tuple(sampled.s.shape), f"{name}: t")
            same(
                again.t, sampled.t, 0.0, f"{name}: must be a function of the rays, the step and the generator"
            )
            # Weights are of the steps between edges: one that is out of order would be negative.
            for edges, low, high in (
                (sampled.s, torch.zeros(count), torch.ones(count)),
                (sampled.t, rays.near, rays.far),
            ):
                require(bool((edges.diff(dim=1) >= 0).all()), f"{name}: edges must be sorted")
                slack = 1e-4 * (high - low)[:, None]
                inside = (edges >= low[:, None] - slack) & (edges <= high[:, None] + slack)
                require(bool(inside.all()), f"{name}: edges must lie between near and far")
            for level in sampled.levels:
                tensor(
                    level.weights,
                    (count, level.s.shape[1] - 1),
                    f"{name}: weights of a proposal level",
                    low=0.0,
                )
    sampler.double()
    penalties(sampler, name)
    rays = Rays(*(x.double() for x in cases.rays(6)))
    for seed in (None, 3):
        follows(lambda seed=seed: sample(rays, seed).t, rays.near, f"{name}: t")  # type: ignore[misc]


def check_content_field(config: ContentFieldConfig) -> None:
    """Density at least 0, content of so many channels, a function of its seed, trainable in every
    parameter.
    """
    field, name = _built(config, ContentField, lambda: config.build(channels=7, seed=0))
    points = cases.points(13)
    view = nn.functional.normalize(cases.normal(13, 3, seed=14), dim=1)
    # Density everywhere, content only of some points, by their latents: the parts that the renderer asks for.
    sample = field.density(points)
    tensor(sample.density, (13,), f"{name}: density", low=0.0)
    content = field.content(sample.latent, view)
    tensor(content, (13, 7), f"{name}: content")
    for some in (slice(4, 9), slice(0, 0)):
        part = field.content(sample.latent[some], view[some])
        same(part, content[some], 1e-4, f"{name}: content: a point must not depend on the others")
    pointwise(lambda some: field.density(some).density, points, name)
    trainable(field, sample.density.sum() + content.square().sum(), name)
    field.double()
    penalties(field, name)
    points = points.double()
    view = view.double()
    latent = field.density(points).latent
    follows(lambda: field.density(points).density, points, f"{name}: density")
    follows(lambda: field.content(latent, view), points, f"{name}: content")
    decoder = MlpDecoder(7, 5).double()
    with torch.no_grad():
        shown = field.colour(latent, view, decoder)
        same(
            shown, decoder(field.content(latent, view)), 1e-9, f"{name}: colour must be the content, decoded"
        )


def check_semantic_field(config: SemanticFieldConfig) -> None:
    """Features of so many channels, a function of its seed, trainable in every parameter."""
    field, name = _built(config, SemanticField, lambda: config.build(channels=5, seed=0))
    points = cases.points(13)
    features = field(points)
    tensor(features, (13, 5), name)
    pointwise(lambda some: field(some), points, name)
    trainable(field, features.square().sum(), name)
    field.double()
    penalties(field, name)
    points = points.double()
    follows(lambda: field(points), points, name)


def check_layout(config: LayoutConfig) -> None:
    """Cells with room in them and one border, from any site, and weights of them that sum to 1 everywhere."""
    layout, name = _built(config, BlockLayout, config.build)
    # A capture with a reconstruction, few views without one, and a single view.
    for site in (cases.site(40, 200), cases.site(3, 0), cases.site(1, 0)):
        cells = layout.cut(site)
        again = layout.cut(site)
        require(len(cells) > 0, f"{name}: at least one block is needed")
        for cell, other in zip(cells, again, strict=True):
            shapes = set()
            for each in (cell.low, cell.high, cell.border):
                shapes.add(tuple(each.shape))
            require(shapes == {(3,)}, f"{name}: low, high and border must be [3], found {shapes}")
            require(
                bool((cell.low < cell.high).all()),
                f"{name}: a cell's lowest corner must lie below its highest",
            )
            require(torch.equal(cell.border, cells[0].border), f"{name}: all cells must have the same border")
            turned = not torch.equal(cell.frame, torch.eye(3, dtype=torch.float64))
            require(not turned, f"{name}: cells must be boxes along the axes of the site")
            same = torch.equal(cell.low, other.low) and torch.equal(cell.high, other.high)
            require(same, f"{name}: must be deterministic")
        require(
            bool((cells[0].border > 0).all()) or len(cells) == 1,
            f"{name}: blocks need a border above 0 to blend in",
        )
        # Blocks and surroundings together must explain every place, also far outside.
        weight = routing.shares(4 * cases.points(64), cells).float()
        shares(weight, (64, len(cells) + 1), f"{name}: weights of cells and surroundings")


def check_parser(config: DataParserConfig, data: Path) -> None:
    """A scene of `data`, a folder of that format: rigid poses, cameras that fit the paths, disjoint
    splits.
    """
    parser, name = _built(config, DataParser, config.build)
    scene, *smaller = (parser.parse(data, downscale) for downscale in (1, 2, 2.5))
    count = len(scene.paths)
    cameras = scene.cameras
    require(count > 0 and len(cameras) == count, f"{name}: {count} paths but {len(cameras)} cameras")
    require(
        cameras.pose.dtype == torch.float64 and tuple(cameras.pose.shape) == (count, 3, 4),
        f"{name}: pose [V 3 4] fp64",
    )
    # Poses are rotations and positions: a scale or a mirroring would go unnoticed until the renders are
    # wrong.
    turn = cameras.pose[:, :, :3]
    rigid = close(turn @ turn.mT, torch.eye(3).double().expand(count, 3, 3), 1e-3)
    require(
        rigid and bool((torch.linalg.det(turn) > 0).all()), f"{name}: poses must be rotations, right-handed"
    )
    require(
        bool((cameras.focal > 0).all() and (cameras.size > 0).all()),
        f"{name}: focal lengths and sizes must be above 0",
    )
    # Held-out views must not be learnt from, and the same folder must give the same numbers each time.
    views = torch.cat([scene.train, scene.test])
    require(len(set(views.tolist())) == len(views), f"{name}: a view must not be in train and test")
    require(
        len(scene.train) > 0 and 0 <= int(views.min()) <= int(views.max()) < count,
        f"{name}: splits must index views",
    )
    for downscale, other in zip((2, 2.5), smaller, strict=True):
        fits = bool((other.cameras.size - scene.cameras.size / downscale).abs().max() <= 1)
        require(fits, f"{name}: downscale={downscale} must divide the size by it")
    require(
        parser.parse(data, 1).paths == scene.paths,
        f"{name}: the order of the views must be the same each time",
    )
    # Recognition looks at every folder that a user names: it must not claim what it cannot read.
    known = config.recognises(data)
    require(
        known is None or 0 < known.confidence <= 1,
        f"{name}: its confidence must lie in (0, 1], or None be given",
    )
    require(
        config.recognises(data / "no-such-folder") is None,
        f"{name}: must not recognise a folder that is absent",
    )
    require(config.recognises(scene.paths[0]) is None, f"{name}: must not recognise an image as a folder")
    try:
        parser.parse(data / "no-such-folder", 1)
    except DataError:
        return
    raise AssertionError(f"{name}: a folder that is absent must be a DataError")


def check_data_manager(config: DataManagerConfig) -> None:
    """Batches that are a function of (seed, step), of training views alone, with the colours and features of
    their pixels.
    """
    check_config(config)
    name = type(config).__name__
    encoder = RandomConfig(channels=5, stride=3).build()
    with tempfile.TemporaryDirectory() as folder:
        scene = cases.capture(Path(folder))

        def build(seed: int = 0, *, features: bool = True) -> DataManager:
            given = encoder if features else None
            return config.build(
                TrainingPixels(scene=scene),
                FeatureTargets(content=given, semantic=given, dim=3),
                cache=Path(folder, "cache"),
                seed=seed,
            )

        manager = build()
        again = build()
        plain = build(features=False)
        require(
            isinstance(manager, DataManager),
            f"{name}: build() gives {type(manager).__name__}, not a DataManager",
        )
        # A resumed run draws the batches of the one that was interrupted.
        batch = manager.batch(3)
        later = manager.batch(4)
        for other in (manager, again, manager.to(torch.device("cpu"), room=0)):
            for mine, theirs in zip(other.batch(3), batch, strict=True):
                equal = mine is theirs is None or (
                    mine is not None and theirs is not None and torch.equal(mine, theirs)
                )
                require(equal, f"{name}: a batch must be a function of the seed and the step")
        count = len(batch.rgb)
        require(config.batch_rays() == count, f"{name}: batch_rays() must be the rays of a batch, {count}")
        require(not torch.equal(batch.pixel, later.pixel), f"{name}: another step must bring other pixels")
        require(
            not torch.equal(batch.pixel, build(1).batch(3).pixel),
            f"{name}: another seed must bring other pixels",
        )
        tensor(batch.pixel, (count, 2), f"{name}: pixel")
        tensor(batch.rgb, (count, 3), f"{name}: rgb")
        require(
            batch.view.dtype == torch.int64 and batch.view.shape == (count,),
            f"{name}: view must be int64 [R]",
        )
        require(
            bool(torch.isin(batch.view, scene.train).all()),
            f"{name}: batches must be of training views alone",
        )
        # Colours and pixels belong together: each is looked up in the view that it names.
        corner = batch.pixel - 0.5
        inside = (corner == corner.floor()) & (corner >= 0) & (corner < scene.cameras.size[batch.view])
        require(bool(inside.all()), f"{name}: pixels must be centres, at +0.5, within their image")
        images = []
        for view in range(len(scene.paths)):
            images.append(manager.image(view))
        for image, (width, height) in zip(images, scene.cameras.size.tolist(), strict=True):
            tensor(image, (height, width, 3), f"{name}: image", low=0.0, high=1.0)
        parts = []
        for v, (x, y) in zip(batch.view.tolist(), corner.long().tolist(), strict=True):
            parts.append(images[v][y, x])
        shown = torch.stack(parts)
        same(batch.rgb, shown, 1e-6, f"{name}: rgb must be the colour of the pixel, as image() gives it")
        # Stores say what units and how many channels the fields are built with.
        content = manager.content_store
        semantic = manager.semantic_store
        require(
            content is not None and semantic is not None, f"{name}: must have stores where encoders are given"
        )
        assert content is not None and semantic is not None
        require(
            (content.channels, semantic.channels) == (5, 3),
            f"{name}: stores must have the encoder's channels, and `dim`",
        )
        require(
            batch.content is not None and batch.semantic is not None,
            f"{name}: batches must bring what stores hold",
        )
        assert batch.content is not None and batch.semantic is not None
        tensor(batch.content, (count, 5), f"{name}: content")
        tensor(batch.semantic, (None, 3), f"{name}: semantic")
        require(0 < len(batch.semantic) <= count, f"{name}: semantic must be of the first Q rays, 0 < Q <= R")
        require(plain.content_store is None and plain.semantic_store is None, f"{name}: no encoder, no store")
        bare = plain.batch(3)
        require(bare.content is None and bare.semantic is None, f"{name}: no encoder, no targets")
        require(torch.equal(bare.pixel, batch.pixel), f"{name}: pixels must not depend on the encoders")


def check_loss_term(config: LossTermConfig) -> None:
    """A finite scalar with a gradient, a function of render, batch, step and generator, which reads no number
    of the device.
    """
    term, name = _built(config, LossTerm, config.build)
    require(isinstance(term.needs, Want), f"{name}: needs must be a Want")
    parts = cases.parts()
    count = 6
    rendered = render_rays(
        cases.rays(count),
        parts,
        want=Want.DENSITY | term.needs,
        budget=0.0,
        training=TrainingStep(step=10, semantic_rays=count // 2),
    )
    assert rendered.weights is not None
    bare = cases.batch(count)._replace(content=None, semantic=None)

    def value(rendered: Rendered, batch: Batch, seed: int | None = None) -> torch.Tensor:
        generator = None
        if seed is not None:
            generator = torch.Generator().manual_seed(seed)
        return term(rendered, batch, parts, step=10, generator=generator)

    for batch, render in ((cases.batch(count), rendered), (bare, rendered._replace(semantic=None))):
        for seed in (None, 3):
            with Unread(name):
                loss = value(render, batch, seed)
            tensor(loss, (), f"{name}: the term")
            same(
                value(render, batch, seed),
                loss,
                0.0,
                f"{name}: must be a function of its inputs and the generator",
            )
    loss = value(rendered, cases.batch(count))
    require(loss.requires_grad, f"{name}: no gradient goes through the term")
    for gradient in torch.autograd.grad(
        loss, [p for m in parts if isinstance(m, nn.Module) for p in m.parameters()], allow_unused=True
    ):
        require(gradient is None or bool(gradient.isfinite().all()), f"{name}: its gradient is not finite")
    # At the beginning rays may meet nothing, or a wall at once: no term may divide by what is not there.
    nothing = torch.zeros_like(rendered.weights)
    for weights, kind in (
        (nothing, "that meet nothing"),
        (nothing.index_fill(1, torch.tensor([2]), 1.0), "that end at once"),
    ):
        weights.requires_grad_()
        loss = value(rendered._replace(weights=weights, opacity=weights.detach().sum(1)), cases.batch(count))
        tensor(loss, (), f"{name} of rays {kind}")
        moved = None
        if loss.requires_grad:
            moved = torch.autograd.grad(loss, weights, allow_unused=True)[0]
        require(
            moved is None or bool(moved.isfinite().all()),
            f"{name}: its gradient for rays {kind} is not finite",
        )
    follows(lambda: value(rendered, cases.batch(count)), rendered.weights, name)


def check_executor(config: ExecutorConfig) -> None:
    """Results in the order of the tasks; an error reaches the caller."""
    executor, name = _built(config, Executor, config.build)
    require(
        executor.map(math.factorial, [5, 0, 3]) == [120, 1, 6],
        f"{name}: results must be in the order of the tasks",
    )
    require(executor.map(math.factorial, []) == [], f"{name}: no tasks, no results")
    try:
        executor.map(math.factorial, [1, -1])
    except ValueError:
        return
    raise AssertionError(f"{name}: an error in a task must reach the caller")


def check_capture_format(form: "CaptureFormat") -> None:
    """A format reads what it writes: as many Gaussians of the same places and colours; recolouring changes
    nothing else.

    Damaged files end in DataError.
    """
    import numpy as np

    from ..splats.gaussians import Gaussians

    check_config(form)
    name = type(form).__name__
    path = Path("capture")
    if not (form.reads and form.writes):
        try:
            form.read(path, b"")
        except DataError:
            return
        require(False, f"{name}: an empty file must raise DataError")
    made = Gaussians(
        cases.normal(50, 3, seed=30),
        torch.nn.functional.normalize(cases.normal(50, 4, seed=31), dim=1),
        cases.normal(50, 3, seed=32) - 3,
        cases.normal(50, seed=33),
        0.3 * cases.normal(50, 4 if form.view_dependent else 1, 3, seed=34),
    )
    data = b"".join(form.pack(made, form.view_dependent, (0.0, 0.0, 0.0)))
    require(form.recognises(data[:64], len(data)), f"{name}.recognises: must be True of a file that it wrote")
    read = form.read(path, data)
    found = read.gaussians
    apart = torch.cdist(made.means, read.gaussians.means)
    require(len(found) == len(made), f"{name}: {len(found)} Gaussians come back of {len(made)}")
    require(
        read.antialiased == form.view_dependent, f"{name}: whether opacities are compensated must come back"
    )
    order = apart.argmin(1)
    same(found.means[order], made.means, 0.02, f"{name}: positions must come back")
    same(found.colours[order], made.colours, 0.05, f"{name}: colours must come back")
    require(read.data == data, f"{name}: Capture.data must be the file")
    # Every second colour is changed; geometry and the other colours stay bit for bit.
    changed = np.arange(len(found)) % 2 == 0
    new = torch.where(torch.from_numpy(changed)[:, None, None], 0.5 * found.harmonics, found.harmonics)
    again = form.read(path, b"".join(read.recolour(new.numpy(), changed))).gaussians
    for part in ("means", "quaternions", "log_scales", "logits"):
        same(
            getattr(again, part), getattr(found, part), 0.0, f"{name}.recolour: {part} must stay as they are"
        )
    same(again.colours, 0.5 + HARMONIC * new[:, 0], 0.05, f"{name}.recolour: the new colours must be there")
    # Files are cut short by full disks and broken downloads.
    for wrong in (b"", data[: len(data) // 2]):
        try:
            shorter = len(form.read(path, wrong).gaussians)
        except DataError:
            continue
        require(
            0 < shorter < len(made),
            f"{name}: a file that is cut off must raise DataError, or hold fewer Gaussians",
        )
