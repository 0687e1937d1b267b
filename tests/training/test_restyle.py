from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_world import World

from fprf.errors import ConfigError, DataError, UsageError, WeightsError
from fprf.io.images import write_image
from fprf.plugins.stylizers.config import AdainConfig, IdentityConfig, LocalAdainConfig, RegionAdainConfig, RegionOtConfig
from fprf.style.config import NO_MASK, StyleConfig
from fprf.style.files import StyleFile
from fprf.training.restyle import apply_style, restyle
from fprf.training.views import render_view


def test_the_order_of_references_does_not_matter(world: World) -> None:
    trained, (a, b) = world.load(), world.references
    one = restyle(trained, [a, b], RegionOtConfig(), weights=(2.0, 1.0)).dictionary
    two = restyle(trained, [b, a], RegionOtConfig(), weights=(1.0, 2.0)).dictionary
    assert one.names == two.names
    for x, y in zip(one, two, strict=True):
        assert torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y


def test_weights_and_blend_count(world: World) -> None:
    trained = world.load()
    even = restyle(trained, world.references, AdainConfig()).dictionary
    heavy = restyle(trained, world.references, AdainConfig(), weights=(9.0, 1.0)).dictionary
    whole = restyle(trained, world.references, AdainConfig(), blend=1.0).dictionary
    assert not torch.equal(even.weight, heavy.weight) and not torch.equal(even.mean, whole.mean)
    for of in whole.reference.unique():
        codes = whole.mean[whole.reference == of]
        assert torch.allclose(codes, codes[:1].expand_as(codes), atol=1e-5), "all of its reference's overall style"


def test_mistakes(world: World, tmp_path: Path) -> None:
    trained = world.load()
    with pytest.raises(UsageError, match="--references: at least one photograph"):
        restyle(trained, [], RegionOtConfig())
    with pytest.raises(ConfigError, match="weights: 3 weights for 2 references"):
        restyle(trained, world.references, RegionOtConfig(), weights=(1.0, 2.0, 3.0))
    with pytest.raises(DataError, match=r"absent\.jpg"):
        restyle(trained, [tmp_path / "absent.jpg"], RegionOtConfig())
    (tmp_path / "text.jpg").write_text("no picture")
    with pytest.raises(DataError, match=r"text\.jpg"):
        restyle(trained, [tmp_path / "text.jpg"], RegionOtConfig())


@pytest.mark.parametrize("which", ["content", "semantic"])
def test_other_encoders_than_the_scenes_are_refused(world: World, which: str) -> None:
    trained = world.load()
    changed = {f"{which}_encoder": f"bundled-{which}:000000000000"}
    facts = replace(trained.known.facts, **changed)  # type: ignore[arg-type]
    with pytest.raises(WeightsError, match=f"{which} encoder: the scene was trained with bundled-{which}:000000000000"):
        restyle(replace(trained, known=replace(trained.known, facts=facts)), world.references, RegionOtConfig())


def paint(path: Path, pixels: np.ndarray) -> Path:
    write_image(path, pixels.astype(np.uint8))
    return path


@pytest.mark.parametrize(
    ("height", "width", "colour"),
    [(1, 1, (3, 200, 90)), (90, 120, (0, 0, 0)), (2, 300, None)],
)
def test_degenerate_photographs_give_finite_pictures(
    world: World, tmp_path: Path, height: int, width: int, colour: tuple[int, int, int] | None
) -> None:
    """One pixel, one colour, a strip of noise: from the file to colours, with every stylizer and any number of clusters."""
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3))
    path = paint(tmp_path / "x.png", noise if colour is None else np.broadcast_to(colour, (height, width, 3)))
    trained = world.load()
    encoders, known = trained.encoders(), trained.known
    for clusters in (1, 13):
        for stylizer in (IdentityConfig(), AdainConfig(), LocalAdainConfig(), RegionAdainConfig(), RegionOtConfig()):
            style = StyleConfig(references=(path,), clusters=clusters, stylizer=stylizer, keep_below=-0.5, luminance=0.5)
            styled = apply_style(trained, StyleFile(style), encoders)
            assert all(bool(t.isfinite().all()) for t in styled.dictionary[:6])
            view = render_view(trained.model, known.facts, known.cameras, 1, trained.config.render, styled.restyle)
            assert bool(view.rgb.isfinite().all()), (stylizer, clusters)


def test_masks_belong_to_their_references_in_any_order(world: World, tmp_path: Path) -> None:
    trained = world.load()
    encoders = trained.encoders()
    white = np.zeros((40, 56, 3))
    white[:20] = 255
    mask, (a, b) = paint(tmp_path / "m.png", white), world.references
    one = apply_style(trained, StyleFile(StyleConfig(references=(a, b), masks=(mask, NO_MASK))), encoders).dictionary
    two = apply_style(trained, StyleFile(StyleConfig(references=(b, a), masks=(NO_MASK, mask))), encoders).dictionary
    assert one.names == two.names and all(torch.equal(x, y) for x, y in zip(one[:6], two[:6], strict=True))
    plain = apply_style(trained, StyleFile(StyleConfig(references=(a, b))), encoders).dictionary
    # The order of a dictionary follows what its references hold, so they are compared by name.
    for name, same in ((a.name, False), (b.name, True)):
        means = [d.mean[d.reference == d.names.index(name)] for d in (one, plain)]
        assert (means[0].shape == means[1].shape and torch.equal(*means)) == same


@pytest.mark.slow
def test_a_hundred_photographs_in_any_order(world: World, tmp_path: Path) -> None:
    drawn = np.random.default_rng(0)
    paths = tuple(paint(tmp_path / f"{i}.png", drawn.integers(0, 256, (24, 32, 3))) for i in range(100))
    trained = world.load()
    encoders = trained.encoders()
    one, two = (
        apply_style(trained, StyleFile(StyleConfig(references=order, clusters=3)), encoders)
        for order in (paths, tuple(paths[i] for i in drawn.permutation(100)))
    )
    assert one.dictionary.names == two.dictionary.names
    assert all(torch.equal(x, y) for x, y in zip(one.dictionary[:6], two.dictionary[:6], strict=True))
    known = trained.known
    view = render_view(trained.model, known.facts, known.cameras, 0, trained.config.render, one.restyle)
    assert bool(view.rgb.isfinite().all())
