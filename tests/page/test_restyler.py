"""What the viewer shows: looks, pictures that grow sharper, maps, films."""

import json
from collections.abc import Generator, Hashable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from session_helpers import Listener, camera_of, keys_of, until
from tiny_world import World

from fprf.cli import main as cli
from fprf.errors import UsageError
from fprf.io.images import Picture, to_uint8
from fprf.io.maps import match_image
from fprf.page import drawing, films, messages
from fprf.page.drawing import (
    Restyler,
    ScenePainter,
    matching_regions,
)
from fprf.page.films import film_cameras, film_frames, write_film_files
from fprf.page.looks import Look, Photograph, Shown
from fprf.page.session import Session
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.match_maps import match_map
from fprf.style.regions import Regions, membership_view
from fprf.style.restyle import apply_style
from fprf.training.views import render_view


def rendered(restyler: Restyler, restyle: Restyle | None) -> torch.Tensor:
    trained = restyler.scene
    return render_view(
        trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle
    ).rgb


def test_a_look_is_the_style_that_the_command_line_makes(
    restyler: Restyler, encoded: tuple[Photograph, Photograph]
) -> None:
    a, b = encoded
    style = StyleConfig(strength=0.8, clusters=3, luminance=0.2)
    look = Look(mix=((a, 1.0), (b, 0.5)), style=style).ruled(1, "pin", b)
    wanted = apply_style(restyler.scene, StyleFile(look.config()))
    assert torch.allclose(
        rendered(restyler, restyler.restyle(look)), rendered(restyler, wanted.restyle), atol=2e-5
    )


def test_styles_are_kept_and_bounded(restyler: Restyler, encoded: tuple[Photograph, Photograph]) -> None:
    first = Look(mix=((encoded[0], 1.0),), style=StyleConfig(clusters=2))
    styled = restyler.styled(first)
    assert restyler.styled(replace(first)) is styled
    for step in range(30):
        restyler.styled(replace(first, style=replace(first.style, strength=0.01 * (step + 1))))
    assert len(restyler._styles) <= 24 and len(restyler._dictionaries) == 1
    restyler.retain(encoded[:1])
    assert restyler._styles and restyler._dictionaries
    restyler.retain([])
    assert not restyler._styles and not restyler._dictionaries


def test_a_pixel_finds_the_region_that_is_there(restyler: Restyler) -> None:
    cameras = restyler.scene.cameras.select(torch.tensor([2]))
    share, _ = membership_view(
        Regions(restyler.scene, restyler.encoders.scene_style, restyler.encoders.basis), 2, 1000
    )
    for x, y in ((3, 4), (20, 18), (31, 23)):
        assert restyler.region_at(cameras, (x + 0.5, y + 0.5)) == int(share[y, x].argmax())


def test_regions_are_matched_whatever_their_order(restyler: Restyler) -> None:
    generator = torch.Generator().manual_seed(0)
    keys, noise = torch.randn(2, 6, 8, generator=generator)
    style = restyler.encoders.scene_style._replace(
        keys=keys, semantic_mean=torch.randn(8, generator=generator)
    )
    order = torch.randperm(6, generator=generator)
    moved = style._replace(keys=keys[order] + 0.01 * noise)
    assert torch.equal(order[matching_regions(style, moved)], torch.arange(6))
    assert matching_regions(style, style._replace(keys=keys[:4])).max() < 4
    blind = style._replace(keys=keys[:, :0])
    assert torch.equal(matching_regions(blind, blind), torch.zeros(6, dtype=torch.int64))


Pair = tuple[Photograph, Photograph]


class Watched(ScenePainter):
    """A painter whose pictures are kept."""

    def __init__(self, restyler: Restyler) -> None:
        super().__init__(restyler.scene, restyler, lambda client, *picture: self.pictures.append(picture), 32)
        self.pictures: list[tuple[str, Picture, bool]] = []

    def look(
        self, shown: Shown | None = None, view: int = 2, client: Hashable = 1, captured: bool = False
    ) -> list[Any]:
        self.pictures.clear()
        camera = camera_of(self._scene, view)
        for _ in self.render(
            client, messages.ViewRequest(camera=camera, captured=captured), shown or Shown(Look())
        ):
            pass
        return list(self.pictures)


@pytest.fixture
def watched(restyler: Restyler) -> Watched:
    return Watched(restyler)


def rendered_view(restyler: Restyler, look: Look) -> Picture:
    trained = restyler.scene
    restyle = restyler.restyle(look)
    view = render_view(
        trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle
    )
    return to_uint8(view.rgb)


def test_pictures_grow_sharper_and_the_last_is_what_is_rendered(watched: Watched, restyler: Restyler) -> None:
    pictures = watched.look()
    assert [picture.shape for _, picture, _ in pictures] == [(4, 5, 3), (24, 32, 3)]
    assert [final for _, _, final in pictures] == [False, True]
    assert np.abs(pictures[-1][1].astype(int) - rendered_view(restyler, Look())).max() <= 1


def test_another_look_marches_nothing(
    watched: Watched, restyler: Restyler, encoded: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched.look()
    look = Look(mix=((encoded[0], 1.0),), style=StyleConfig(clusters=2))
    with monkeypatch.context() as patch:
        patch.setattr(drawing, "strips_of", None)
        found = watched.look(Shown(look), captured=True)
    assert [(kind, final) for kind, _, final in found] == [("look", True), ("captured", True)]
    for (_, picture, _), each in zip(found, (look, Look()), strict=True):
        assert np.abs(picture.astype(int) - rendered_view(restyler, each)).max() <= 1
    assert len(watched.look(view=3)) == 2, "another camera has a preview"
    watched.forget(1)
    assert len(watched.look(view=3)) == 2


def test_memory_is_bounded(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "CACHE_BYTES", 1 << 10)
    assert len(watched.look()) == len(watched.look()) == 2, "nothing was kept"


def test_maps_are_what_the_command_line_renders(watched: Watched, restyler: Restyler, encoded: Pair) -> None:
    a, b = encoded
    look = Look(mix=((a, 1.0), (b, 1.0)), style=StyleConfig(clusters=3)).ruled(0, "keep")
    trained = restyler.scene
    styled = restyler.styled(look)
    found = match_map(trained, styled, 2)
    wanted = match_image(
        found.attention, styled.codes.reference, styled.codes.names, found.opacity, found.kept
    )
    assert np.abs(watched.look(Shown(look, "matches"))[-1][1].astype(int) - wanted).mean() < 0.5
    assert (watched.look(Shown(Look(), "matches"))[-1][1] == 128).all(), "grey without a style"


def test_a_picked_region_stands_out(watched: Watched, restyler: Restyler) -> None:
    whole = watched.look()[-1][1].astype(int)
    shown = [
        watched.look(Shown(Look(), region=region))[-1][1].astype(int)
        for region in range(len(restyler.encoders.scene_style.share))
    ]
    # Each is grey but for its region's share, and the shares of all regions are the whole.
    grey = 0.45 * whole.mean(-1, keepdims=True)
    assert np.abs(sum(each - grey for each in shown) - (whole - grey)).max() <= len(shown)
    assert len(shown) > 1 and all(np.abs(each - whole).max() > 20 for each in shown)


def frame_of(frame: Generator[None, None, Picture]) -> Picture:
    while True:
        try:
            next(frame)
        except StopIteration as end:
            return np.asarray(end.value)


def test_the_film_is_what_fprf_render_makes_of_its_folder(
    restyler: Restyler, encoded: tuple[Photograph, Photograph], run: Path, tmp_path: Path
) -> None:
    a, b = encoded
    scene = restyler.scene
    few = StyleConfig(clusters=3)
    one = Look(mix=((a, 1.0),), style=few).ruled(0, "keep")
    two = Look(mix=((b, 1.0),), style=few)
    faint = Look(mix=((a, 1.0),), style=replace(few, strength=0.75))
    folder = run / "films" / "0001"
    folder.mkdir(parents=True)
    film = messages.Film(seconds=0.125, side=64)
    write_film_files(folder, keys_of(scene, [Look(), one, two, faint, one]), film, scene)
    rows = json.loads((folder / "keys.json").read_text())["keyframes"]
    numbers = (None, 1, 2, 3, 1)  # one file a look
    assert rows == [{"frame": 3 * i, "style": n and f"style-{n}/style.json"} for i, n in enumerate(numbers)]
    style = json.loads((folder / "style-3" / "style.json").read_text())["style"]
    assert style["strength"] == 0.75
    assert style["references"] == ["1-dusk.png"] and (folder / "style-3" / "1-dusk.png").is_file()
    frames = [frame_of(each) for each in film_frames(folder, scene)]
    assert len(frames) == 13
    args = ["render", str(run), "--path", str(folder / "path.json"), "--keyframes", str(folder / "keys.json")]
    assert cli.main([*args, "--output", str(tmp_path / "frames")]) == 0
    pictures = [cv2.imread(str(p))[..., ::-1] for p in sorted((tmp_path / "frames").glob("*.png"))]
    for mine, its in zip(frames, pictures, strict=True):
        assert np.array_equal(mine, its)
    assert not np.array_equal(frames[0], frames[3])


def test_paths_pass_through_their_keys(world: World) -> None:
    keys = keys_of(world.load(), [Look()] * 4)
    path = film_cameras(keys, messages.Film(seconds=0.2, side=64))
    assert len(path) == 3 * 5 + 1 and path.size[0].tolist() == [64, 48]
    assert len(film_cameras(keys, messages.Film(seconds=0.2, side=64, fps=60))) == 3 * 12 + 1
    assert np.allclose(path.pose[::5, :, 3], [key.camera.place for key in keys], atol=1e-9)
    assert len(film_cameras(keys[:1], messages.Film(seconds=0.2))) == 1
    for some, film in ((), messages.Film()), (keys, messages.Film(seconds=400.0)):
        with pytest.raises(UsageError, match="film"):
            film_cameras(some, film)


def test_a_film_that_cannot_be_written_leaves_room_for_the_next(
    session: Session, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, frames: Iterator[object], fps: float) -> None:
        next(frames)
        raise OSError("disk full")

    scene = session.viewed.scene
    session.apply(lambda state: replace(state, keys=keys_of(scene, [Look()] * 2)))
    with monkeypatch.context() as patch:
        patch.setattr(films, "write_video", full)
        session.handle(1, messages.Film(seconds=1.0, side=64))
        listener.until_said("disk full")
    session.handle(1, messages.Film(seconds=0.2, side=64))
    with pytest.raises(UsageError, match="one is being made"):
        session.handle(1, messages.Film(seconds=0.2, side=64))
    until(lambda: session.state.film.path is not None)
    film = session.state.film
    path = film.path
    assert path is not None and path.stat().st_size > 500 and film.done == film.total == 6
    assert path.parent.parent == session.viewed.root / "films" and (path.parent / "keys.json").is_file()
