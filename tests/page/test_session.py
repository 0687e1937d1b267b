import io
import json
import sys
import threading
import zipfile
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from session_helpers import Listener, camera_of, until
from splat_ball import ball
from tiny_world import World

from fprf.cli import view
from fprf.errors import DataError, FprfError, UsageError
from fprf.page import messages
from fprf.page.access import Access
from fprf.page.downloads import SAVED_FORMATS
from fprf.page.messages import SHELF
from fprf.page.render_worker import Steps
from fprf.page.server import ViewerServer
from fprf.page.session import Session, view_of_run
from fprf.page.state import MAX_UNDONE_PHOTOGRAPHS, SharedState
from fprf.splats.files import read_capture, write_gaussians
from fprf.training.loading import open_run


def unpacked(body: bytes) -> tuple[dict[str, object], dict[str, bytes]]:
    """Head and sections of a body that browsers read."""
    length = int.from_bytes(body[:4], "little")
    head = json.loads(body[4 : 4 + length])
    parts = {}
    at = 4 + length
    for name, size in head["sizes"].items():
        parts[name] = zlib.decompress(body[at : at + size])
        at = at + size
    return head, parts


def test_a_photograph_restyles_what_every_client_of_a_field_sees(
    session: Session, listener: Listener, world: World
) -> None:
    for client in (1, 2):
        session.handle(client, messages.ViewRequest(camera=camera_of(session.viewed.scene, client)))
    sharp = lambda client: [each for each in listener.pictures(client) if max(each.shape) == 64]  # noqa: E731
    listener.until(lambda: all(sharp(client) for client in (1, 2)))
    plain = {client: sharp(client)[0] for client in (1, 2)}
    card = session.upload(world.references[0].read_bytes(), "../dusk.png")
    assert card.name == "dusk.png" and session.state.look.mix == ((card, 1.0),)
    listener.until(lambda: all(len(sharp(client)) > 1 for client in (1, 2)))
    for client in (1, 2):
        assert abs(sharp(client)[-1].astype(int) - plain[client]).mean() > 2
    again = session.upload(world.references[0].read_bytes(), "dusk.png")
    assert again.name == "dusk.png (2)" and session.state.shelf == (card, again)
    session.handle(1, messages.ViewRequest(camera=camera_of(session.viewed.scene, 1), captured=True))
    listener.until(lambda: bool(listener.pictures(1, "captured")))


def test_a_photograph_recolours_gaussians_and_they_can_be_saved(
    splats: Session, listener: Listener, world: World
) -> None:
    head, parts = unpacked(splats.geometry)
    assert head["count"] == 400 and len(parts["shape"]) == 16 * 400 and len(parts["style-0"]) == 4 * 400 + 36
    splats.upload(world.references[0].read_bytes(), "dusk.png")
    listener.until(lambda: any(kind == "colours Now" for _, kind, _ in listener.sent))
    about, colours = unpacked(splats.colours("Now"))
    assert len(colours["rows"]) == 4 * 400 + 36 * about["maps"]  # type: ignore[operator]
    splats.handle(1, messages.Keep(name="dusk", action="keep"))
    listener.until(lambda: any(kind == "colours dusk" for _, kind, _ in listener.sent))
    assert unpacked(splats.colours("dusk"))[1]["rows"][: 4 * 400] == colours["rows"][: 4 * 400]
    for shown in ("matches", "regions", "none"):
        count = len(listener.sent)
        splats.handle(1, messages.Map(map=shown))  # type: ignore[arg-type]
        listener.until(lambda count=count: any(kind == "colours Now" for _, kind, _ in listener.sent[count:]))  # type: ignore[misc]
    with pytest.raises(UsageError, match="no such colours"):
        splats.colours("else")
    scene = splats.viewed.scene

    def saved(shown: str, start: str = "Captured", share: float = 1.0, suffix: str = ".ply") -> Any:
        return read_capture(splats.gaussians(shown, start, share, suffix)).gaussians

    plain = scene.gaussians.harmonics
    now = saved("Now")
    assert torch.equal(now.means, scene.gaussians.means) and not torch.equal(now.harmonics, plain)
    # What is shown is what is saved.
    assert torch.equal(saved("Captured").harmonics, plain)
    assert torch.allclose(saved("Now", share=0.5).harmonics, (now.harmonics + plain) / 2, atol=1e-6)
    splats.handle(1, messages.Set(name="strength", value=0.0))
    assert torch.equal(saved("Now").harmonics, plain)
    assert torch.equal(saved("dusk").harmonics, now.harmonics)
    for suffix in SAVED_FORMATS:
        assert len(saved("dusk", suffix=suffix)) > 350
    for wrong in (("no such", "Captured", 1.0, ".ply"), ("Now", "Captured", 1.0, ".exe")):
        with pytest.raises(UsageError):
            splats.gaussians(*wrong)


def test_a_client_may_come_while_looks_are_coloured(
    splats: Session, listener: Listener, world: World
) -> None:
    splats.upload(world.references[0].read_bytes(), "dusk.png")
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for k in range(60):
            splats.handle(1, messages.Keep(name=f"look {k}", action="keep"))
        while "colours look 59" not in {kind for kind, _ in splats.hello()}:
            pass
    finally:
        sys.setswitchinterval(interval)


def test_a_click_picks_a_region_and_its_rules_change_the_look(
    session: Session, listener: Listener, world: World
) -> None:
    camera = camera_of(session.viewed.scene, 2)
    session.handle(1, messages.Pick(camera=camera, x=0.5, y=0.8))
    listener.until(lambda: session.state.picked is not None)
    assert session.state.picked is not None and session.state.picked.taken == ()
    card = session.upload(world.references[0].read_bytes(), "dusk.png")
    session.handle(1, messages.Pick(camera=camera, x=0.5, y=0.8))
    listener.until(lambda: session.state.picked is not None and session.state.picked.taken != ())
    assert session.state.picked is not None
    region = session.state.picked.region
    session.handle(1, messages.Region(action="keep"))
    assert {*session.state.look.rules} == {(region, "keep", None)}
    session.handle(1, messages.Region(action="pin", card=card.number))
    assert {*session.state.look.rules} == {(region, "pin", card)}
    session.handle(1, messages.Region(action="free"))
    session.handle(1, messages.Region(action="close"))
    assert not session.state.look.rules
    listener.until(lambda: session.state.picked is None)
    session._describe(region)  # as asked before it was closed
    assert session.state.picked is None


def test_what_is_wrong_is_said_and_changes_nothing(session: Session, world: World) -> None:
    session.upload(world.references[0].read_bytes(), "dusk.png")
    before = session.state
    for wrong in (
        messages.Set(name="strength", value=7.0),
        messages.Card(card=99, action="alone"),
        messages.Region(action="keep"),
        messages.Keep(name="", action="keep"),
        messages.Film(),
        messages.Key(action="remove", at=0),
    ):
        with pytest.raises(FprfError):
            session.handle(1, wrong)
    assert session.state == before and not (session.viewed.root / "films").exists()  # type: ignore[operator]


@pytest.mark.parametrize(("name", "told"), [("none.jpg", "No such file"), ("text.jpg", "no PNG")])
def test_references_that_cannot_be_taken_are_named(
    splats: Session, tmp_path: Path, name: str, told: str
) -> None:
    (tmp_path / "text.jpg").write_text("text")
    viewed = replace(splats.viewed, references=(tmp_path / name,))
    with (
        ViewerServer(Access("127.0.0.1", None), 0) as server,
        pytest.raises(DataError, match=f"{name}: {told}"),
    ):
        server.open(lambda: viewed)


def test_an_upload_ends_with_the_viewer(session: Session, world: World) -> None:
    session._worker.close()
    with pytest.raises(UsageError, match="the viewer is ending"):
        session.upload(world.references[0].read_bytes(), "dusk.png")


def test_an_unexpected_error_is_told_and_nothing_stops(session: Session, listener: Listener) -> None:
    listener.fails = True
    session.handle(1, messages.ViewRequest(camera=camera_of(session.viewed.scene, 2)))
    listener.until_said("should not have happened")
    listener.fails = False
    session.handle(1, messages.ViewRequest(camera=camera_of(session.viewed.scene, 3)))
    listener.until(lambda: bool(listener.pictures(1)))
    session.disconnect(1)
    session.disconnect(1)


def test_photographs_that_left_the_shelf_are_deleted(session: Session, world: World) -> None:
    for _ in range(SHELF + MAX_UNDONE_PHOTOGRAPHS + 4):
        session.upload(world.references[0].read_bytes(), "x.png")
    assert len(session.state.shelf) == SHELF
    kept = len(list(session.uploads.folder.glob("*.png")))
    assert SHELF < kept <= SHELF + MAX_UNDONE_PHOTOGRAPHS + 1, "some can be brought back"


def test_the_warm_up_leaves_nothing_behind(session: Session, listener: Listener) -> None:
    session.warm_up()
    done = threading.Event()

    def last() -> Steps[None]:
        yield
        done.set()

    session._worker.run_when_idle(last())
    assert done.wait(120)
    assert session.state == SharedState() and listener.sent == [] and not session.restyler._styles


def test_newer_states_of_a_training_are_shown_as_they_come(
    splats: Session, listener: Listener, world: World
) -> None:
    def reloaded(*names: str, **changes: Any) -> None:
        """Show a newer state, whose colours come anew."""
        count = len(listener.sent)
        splats.reload(replace(splats.viewed, **changes))

        def came() -> bool:
            # Colours of the state before may still have been under way.
            kinds = [kind for _, kind, _ in listener.sent[count:]]
            after = kinds[kinds.index("scene") :] if "scene" in kinds else []
            return {f"colours {name}" for name in names} <= {*after}

        listener.until(came)

    splats.upload(world.references[0].read_bytes(), "dusk.png")
    splats.handle(1, messages.Keep(name="dark", action="keep"))
    listener.until(lambda: {"colours Now", "colours dark"} <= {kind for _, kind, _ in listener.sent})
    before = splats.geometry
    scene = splats.viewed.scene
    moved = replace(scene, gaussians=replace(scene.gaussians, means=scene.gaussians.means + 0.1))  # type: ignore[type-var]
    count = len(listener.sent)
    reloaded("Now", "dark", scene=moved, step=9)
    scenes = [message for _, kind, message in listener.sent[count:] if kind == "scene"]
    assert scenes[-1]["step"] == 9 and splats.geometry != before
    splats.trained({"step": 9, "share": 0.5})
    assert ("training", {"type": "training", "step": 9, "share": 0.5}) in splats.hello()
    # A map and a region of the captured colours go on as well.
    splats.handle(1, messages.Set(name="strength", value=0.0))
    splats.handle(1, messages.Map(map="regions"))
    splats.handle(1, messages.Pick(camera=camera_of(moved, 2), x=0.5, y=0.5))
    listener.until(lambda: splats.state.picked is not None)
    reloaded("Now", scene=scene, step=10)
    assert splats.state.picked is not None and splats.state.map == "regions"


def test_what_was_made_comes_back_with_the_scene(run: Path, world: World, listener: Listener) -> None:
    viewed = replace(view_of_run(open_run(run, "cpu")), pixels=64)
    with Session(viewed, listener.post) as session:
        session.upload(world.references[0].read_bytes(), "dusk.png")
        session.upload(world.references[1].read_bytes(), "snow.png", join=True)
        camera = camera_of(viewed.scene, 2)
        session.handle(1, messages.Set(name="strength", value=0.7))
        session.handle(1, messages.Pick(camera=camera, x=0.5, y=0.8))
        listener.until(lambda: session.state.picked is not None)
        assert session.state.picked is not None
        region = session.state.picked.region
        session.handle(1, messages.Region(action="keep"))
        session.handle(1, messages.Keep(name="both", action="keep"))
        session.handle(1, messages.Key(action="add", camera=camera, shown="both"))
        session.handle(1, messages.Card(card=session.state.shelf[1].number, action="remove"))
        before = session.state
    with Session(viewed, listener.post) as session:
        listener.until(lambda: len(session.state.kept) > 0)
        now = session.state
        assert [each.name for each in now.shelf] == ["dusk.png"]
        assert [each.name for each, _ in now.look.mix] == ["dusk.png"] and now.look.style.strength == 0.7
        name, look = now.kept[0]
        assert name == "both" and [each.name for each, _ in look.mix] == ["dusk.png", "snow.png"]
        assert look.rules == {(region, "keep", None)} and now.keys[0].camera == before.keys[0].camera
        assert now.keys[0].look == look
        # What is given again is not there twice, and the oldest document is not lost.
        session.upload(world.references[0].read_bytes(), "dusk.png")
    assert {path.name for path in run.glob("page*")} == {"page"}


def test_a_photograph_that_was_dropped_twice_comes_back_once(
    run: Path, world: World, listener: Listener
) -> None:
    viewed = replace(view_of_run(open_run(run, "cpu")), pixels=64)
    data = world.references[0].read_bytes()
    with Session(viewed, listener.post) as session:
        session.upload(data, "dusk.png")
        session.upload(data, "dusk.png", join=True)
        assert [each.name for each in session.state.shelf] == ["dusk.png", "dusk.png (2)"]
    with Session(viewed, listener.post) as session:
        listener.until(lambda: len(session.state.shelf) > 0)
        assert [each.name for each in session.state.shelf] == ["dusk.png"]
        assert [weight for _, weight in session.state.look.mix] == [2.0]


def test_a_page_of_another_version_is_left_alone(run: Path, world: World, listener: Listener) -> None:
    (run / "page").mkdir()
    (run / "page" / "page.json").write_text('{"format": 99}')
    viewed = replace(view_of_run(open_run(run, "cpu")), pixels=64)
    with Session(viewed, listener.post) as session:
        session.upload(world.references[0].read_bytes(), "dusk.png")
    assert (run / "page" / "page.json").read_text() == '{"format": 99}'
    assert (run / "page-2" / "page.json").is_file()


def test_changes_are_undone_and_photographs_come_back(session: Session, world: World) -> None:
    card = session.upload(world.references[0].read_bytes(), "dusk.png")
    session.handle(1, messages.Card(card=card.number, action="remove"))
    assert session.state.shelf == ()
    session.handle(1, messages.Undo())
    assert session.state.shelf == (card,) and card.path.is_file() and session.state.look.mix == ((card, 1.0),)
    session.handle(1, messages.Undo(again=True))
    assert session.state.shelf == () and session.hello()[1][1]["undo"] and not session.hello()[1][1]["redo"]


def test_a_style_is_saved_and_taken_up_again(session: Session, world: World, listener: Listener) -> None:
    session.upload(world.references[0].read_bytes(), "dusk.png")
    second = session.upload(world.references[1].read_bytes(), "snow.png", join=True)
    session.handle(1, messages.Set(name="luminance", value=0.25))
    session.handle(1, messages.Pick(camera=camera_of(session.viewed.scene, 2), x=0.5, y=0.8))
    listener.until(lambda: session.state.picked is not None)
    session.handle(1, messages.Region(action="pin", card=second.number))
    look = session.state.look
    data = session.style_archive("Now").read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert sorted(archive.namelist()) == ["1-dusk.png", "2-snow.png", "style.json"]
        alone = archive.read("style.json")
    for photograph in session.state.shelf:
        session.handle(1, messages.Card(card=photograph.number, action="remove"))
    with pytest.raises(DataError, match=r"1-dusk\.png is not here; give the \.zip"):
        session.take_style(alone)
    session.take_style(data)
    found = session.state.look
    assert found.style == look.style and [weight for _, weight in found.mix] == [1.0, 1.0]
    assert [(rule.region, rule.action) for rule in found.rules] == [
        (rule.region, rule.action) for rule in look.rules
    ]
    assert next(iter(found.rules)).photograph is found.mix[1][0]
    session.handle(1, messages.Set(name="luminance", value=0.5))
    session.take_style(alone)
    assert session.state.look == found and len(session.state.shelf) == 2, "its photographs are on the shelf"
    # No path of this machine: photographs lie beside the file.
    document = json.loads(alone)
    document["style"]["references"] = [str(world.references[0])]
    document["style"]["weights"] = []
    document["style"]["pin"] = []
    document["sha256"] = {}
    with pytest.raises(DataError, match="is not here"):
        session.take_style(json.dumps(document).encode())
    for wrong in (b"PK\3\4 no archive", b"{}", b"\xff"):
        with pytest.raises(FprfError):
            session.take_style(wrong)
    with pytest.raises(UsageError, match="has no style"):
        session.style_archive("Captured")


def test_a_picture_of_a_field_is_what_is_shown_at_any_size(session: Session, world: World) -> None:
    session.upload(world.references[0].read_bytes(), "dusk.png")
    camera = camera_of(session.viewed.scene, 2)

    def picture(**asked: Any) -> np.ndarray:
        data = session.picture(messages.PictureRequest(camera=camera, side=128, **asked))
        return cv2.imdecode(np.frombuffer(data, np.uint8), 1)

    plain = picture(shown="Captured")
    now = picture()
    wiped = picture(wipe=0.5)
    assert plain.shape == (96, 128, 3) and np.abs(plain.astype(int) - now).mean() > 2
    assert np.array_equal(wiped[:, :64], plain[:, :64]) and np.array_equal(wiped[:, 64:], now[:, 64:])


def test_what_takes_its_time_is_told_with_its_share(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_gaussians(tmp_path / "ball.ply", ball(300, 1))
    told: list[dict[str, Any]] = []
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        post = server.post

        def recorded(client: Any, kind: str, message: Any) -> None:
            if isinstance(message, dict) and message["type"] == "wait":
                told.append(message)
            post(client, kind, message)

        monkeypatch.setattr(server, "post", recorded)
        config = view.ViewConfig(output=tmp_path / "out")
        session = server.open(partial(view._load, config, server.wait, tmp_path / "ball.ply"), warm=False)
        session.upload(world.references[0].read_bytes(), "dusk.png")
        until(lambda: "colours Now" in {kind for kind, _ in session.hello()})
        opening = [message["share"] for message in told if message["kind"] == "opening" and message["what"]]
        assert opening[0] == 0 and opening == sorted(opening) and len(set(opening)) > 20
        words = [message["what"] for message in told if message["kind"] == "opening"]
        for text in ("Reading ball.ply", "300 Gaussians", "judging places", "preparing it for the browser"):
            assert any(text in each for each in words), text
        assert words[-1] == ""
        assert all(0 <= message["share"] <= 1 for message in told if message["what"])
        looking = [message for message in told if message["kind"] == "looking"]
        assert any("3 of" in message["what"] and 0 < message["share"] < 1 for message in looking)
        photograph = [message["share"] for message in told if message["kind"] == "photograph"]
        assert photograph == [0.0, 1 / 3, 2 / 3, None]
        until(lambda: not server._waits)
