import torch
from tiny_world import World

from fprf.evaluation.looks import render_looks
from fprf.plugins.stylizers.config import AdainConfig, RegionOtConfig
from fprf.style.look import Restyle
from fprf.training.restyle import restyle
from fprf.training.views import render_view


def test_looks_are_the_renders_of_each_style(world: World) -> None:
    trained = world.load()
    facts, cameras, config = trained.known.facts, trained.known.cameras, trained.config.render
    looks: dict[str, Restyle | None] = {"plain": None}
    looks |= {
        "global": restyle(trained, world.references[:1], AdainConfig()).restyle,
        "regions": restyle(trained, world.references, RegionOtConfig()).restyle,
    }
    pictures, depth = render_looks(trained.model, facts, cameras, 2, config, looks)
    assert set(pictures) == set(looks)
    for name, look in looks.items():
        alone = render_view(trained.model, facts, cameras, 2, config, look)
        assert torch.allclose(pictures[name], alone.rgb, atol=1e-5)
        assert torch.allclose(depth, alone.depth, atol=1e-5)
    assert not torch.allclose(pictures["global"], pictures["plain"], atol=0.02)


def test_looks_do_not_depend_on_the_chunks(world: World) -> None:
    trained = world.load()
    facts, cameras = trained.known.facts, trained.known.cameras.scaled(2)
    looks: dict[str, Restyle | None] = {"it": restyle(trained, world.references[:1], RegionOtConfig()).restyle}
    whole, one = (
        render_looks(trained.model, facts, cameras, 0, type(trained.config.render)(chunk=chunk), looks)[0]["it"]
        for chunk in (10_000, 37)
    )
    assert whole.shape == (12, 16, 3)
    assert torch.allclose(whole, one, atol=1e-5)
