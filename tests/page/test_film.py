import json
from collections.abc import Generator, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from session_helpers import Listener, keys_of, until
from tiny_world import World

from fprf.cli import main as cli
from fprf.errors import UsageError
from fprf.io.images import Picture
from fprf.page import messages
from fprf.page import session as viewer_session
from fprf.page.drawing import Restyler, film_cameras, film_frames, write_film_files
from fprf.page.session import Session
from fprf.page.state import Look, Photograph
from fprf.style.config import StyleConfig


def rendered(frame: Generator[None, None, Picture]) -> Picture:
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
    two, faint = Look(mix=((b, 1.0),), style=few), Look(mix=((a, 1.0),), style=replace(few, strength=0.75))
    folder = run / "films" / "0001"
    folder.mkdir(parents=True)
    write_film_files(folder, keys_of(scene, [Look(), one, two, faint, one]), 0.125, scene, side=32)
    rows = json.loads((folder / "keys.json").read_text())["keyframes"]
    numbers = (None, 1, 2, 3, 1)  # one file a look
    assert rows == [{"frame": 3 * i, "style": n and f"style-{n}/style.json"} for i, n in enumerate(numbers)]
    style = json.loads((folder / "style-3" / "style.json").read_text())["style"]
    assert style["strength"] == 0.75
    assert style["references"] == ["1-dusk.png"] and (folder / "style-3" / "1-dusk.png").is_file()
    frames = [rendered(each) for each in film_frames(folder, scene)]
    assert len(frames) == 13
    args = ["render", str(run), "--path", str(folder / "path.json"), "--keyframes", str(folder / "keys.json")]
    assert cli.main([*args, "--output", str(tmp_path / "frames")]) == 0
    pictures = [cv2.imread(str(p))[..., ::-1] for p in sorted((tmp_path / "frames").glob("*.png"))]
    for mine, its in zip(frames, pictures, strict=True):
        assert np.array_equal(mine, its)
    assert not np.array_equal(frames[0], frames[3])


def test_paths_pass_through_their_keys(world: World) -> None:
    keys = keys_of(world.load(), [Look()] * 4)
    path = film_cameras(keys, 0.2, side=32)
    assert len(path) == 3 * 5 + 1 and path.size[0].tolist() == [32, 24]
    assert np.allclose(path.pose[::5, :, 3], [key.camera.place for key in keys], atol=1e-9)
    assert len(film_cameras(keys[:1], 0.2)) == 1
    for some, seconds in ((), 0.2), (keys, 400.0):
        with pytest.raises(UsageError, match="film"):
            film_cameras(some, seconds)


def test_a_film_that_cannot_be_written_leaves_room_for_the_next(
    session: Session, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, frames: Iterator[object], fps: float) -> None:
        next(frames)
        raise OSError("disk full")

    scene = session.viewed.scene
    monkeypatch.setattr(viewer_session, "write_film_files", partial(write_film_files, side=64))
    session.apply(lambda state: replace(state, keys=keys_of(scene, [Look()] * 2)))
    with monkeypatch.context() as patch:
        patch.setattr(viewer_session, "write_video", full)
        session.handle(1, messages.Film(seconds=1.0))
        listener.until_said("disk full")
    session.handle(1, messages.Film(seconds=0.2))
    with pytest.raises(UsageError, match="one is being made"):
        session.handle(1, messages.Film(seconds=0.2))
    until(lambda: session.state.film[2] is not None)
    done, total, path = session.state.film
    assert path is not None and path.stat().st_size > 500 and done == total == 6
    assert path.parent.parent == session.viewed.root / "films" and (path.parent / "keys.json").is_file()
