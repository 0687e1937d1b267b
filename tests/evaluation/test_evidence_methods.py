"""The methods of a report against what a user would get, and against their words."""

from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.datamanagers.images import load_image
from fprf.evaluation.restyle import dictionary_of, in_scene, nothing, one_by_one, transfers
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionToneConfig, StylizerConfig
from fprf.style.config import StyleConfig
from fprf.style.dictionary import StyleDictionary
from fprf.style.files import StyleFile
from fprf.style.references import Encoders
from fprf.training.loading import Trained
from fprf.training.restyle import apply_style
from fprf.training.views import CachedView, cache_view, render_view


class Stand:
    """A loaded run, two of its views, and the dictionary of its references."""

    def __init__(self, world: World) -> None:
        self.trained: Trained = world.load()
        self.encoders: Encoders = self.trained.encoders()
        known, render = self.trained.known, self.trained.config.render
        self.views: list[CachedView] = [
            cache_view(self.trained.model, known.facts, known.cameras, view, render) for view in (0, 4)
        ]
        self.paths: tuple[Path, ...] = world.references
        self.dictionary: StyleDictionary = self.of(self.paths)

    def of(self, paths: tuple[Path, ...], clusters: int = 4, blend: float = 0.1) -> StyleDictionary:
        return dictionary_of(paths, self.encoders, clusters=clusters, blend=blend)[0]

    def plain(self) -> list[torch.Tensor]:
        return [view.restyled().rgb for view in self.views]


@pytest.fixture
def stand(world: World) -> Stand:
    return Stand(world)


def test_no_change_is_the_render(stand: Stand) -> None:
    shown, trained = nothing(stand.views), stand.trained
    assert shown.taken is None and shown.style_seconds == 0 and shown.view_seconds > 0
    for picture, view in zip(shown.pictures, (0, 4), strict=True):
        rendered = render_view(trained.model, trained.known.facts, trained.known.cameras, view, trained.config.render).rgb
        assert torch.equal(picture, rendered)


@pytest.mark.parametrize("config", [AdainConfig(), LocalAdainConfig(), RegionToneConfig()])
def test_in_the_scene_is_what_a_user_gets(stand: Stand, config: StylizerConfig) -> None:
    style = StyleConfig(references=stand.paths, stylizer=config, clusters=4, blend=0.1)
    look = apply_style(stand.trained, StyleFile(style), stand.encoders).restyle
    shown = in_scene(stand.trained, stand.views, config, stand.dictionary, stand.encoders, stand.paths)
    for picture, view in zip(shown.pictures, stand.views, strict=True):
        assert torch.equal(picture, view.restyled(look).rgb)
    assert (shown.taken is None) == isinstance(config, AdainConfig)
    for taken, picture in zip(shown.taken or [], shown.pictures, strict=False):
        assert taken.shape == (picture.shape[0] * picture.shape[1], len(stand.dictionary.keys))
        total = taken.sum(1)
        assert bool(((total < 1e-4) | ((total - 1).abs() < 1e-4)).all()), "all of a pixel's share, or nothing is there"


def test_alone_every_picture_is_a_scene_of_its_own(stand: Stand) -> None:
    plain = stand.plain()
    shown = one_by_one(stand.trained, plain, RegionToneConfig(), stand.dictionary, stand.encoders)
    assert shown.taken is not None and [x.shape for x in shown.pictures] == [x.shape for x in plain]
    first = one_by_one(stand.trained, plain[:1], RegionToneConfig(), stand.dictionary, stand.encoders)
    assert torch.equal(first.pictures[0], shown.pictures[0]), "no other picture has a say"
    inside = in_scene(stand.trained, stand.views, RegionToneConfig(), stand.dictionary, stand.encoders, stand.paths)
    assert not torch.allclose(inside.pictures[0], shown.pictures[0], atol=1e-3)


def test_transfers_see_one_picture_at_a_time(stand: Stand) -> None:
    references = [torch.from_numpy(load_image(path)).float() / 255 for path in stand.paths]
    plain = stand.plain()
    both, one = transfers(plain, references), transfers(plain[:1], references)
    for name, shown in both.items():
        assert torch.equal(shown.pictures[0], one[name].pictures[0]) and bool((shown.pictures[1] >= 0).all())
    other = transfers(plain[:1], references[:1])
    assert not torch.equal(one["reinhard"].pictures[0], other["reinhard"].pictures[0])
