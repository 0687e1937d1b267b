"""A viewer beside a training: it follows the newest checkpoint of the run folder, without a browser."""

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from session_helpers import camera_of, until
from tiny_world import World

pytest.importorskip("uvicorn", reason="the extra `viewer` is not installed")
from fprf.training import checkpoint
from fprf.training.driver import is_watched
from fprf.training.loading import open_run
from fprf.viewer.live import TrainingFollower
from fprf.viewer.restyler import OpenEncoders
from fprf.viewer.server import ViewerServer
from fprf.viewer.session import Session, Viewed, view_of_run
from fprf.viewer.state import State


class SessionServer(ViewerServer):
    """A server that listens nowhere."""

    def __init__(self) -> None:
        self.visited = threading.Event()
        self.session: Session | None = None

    def open(self, load: Callable[[], Viewed], references: Any, pixels: int, opened: OpenEncoders | None = None) -> Session:
        self.session = Session(load(), State(pixels=64), opened).__enter__()
        return self.session


def test_the_newest_checkpoint_is_shown_and_training_knows_that_somebody_looks(world: World, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(world.run, run)
    (run / "style.safetensors").unlink()  # training has not come so far
    shutil.move(run / "checkpoints", tmp_path / "checkpoints")
    server = SessionServer()

    def load() -> Viewed:
        opened = open_run(run, "cpu")
        return view_of_run(opened.scene, opened.run, opened.known)

    follower = TrainingFollower(server, run, load)
    follower.tick(100.0)
    assert server.session is None and not is_watched(run), "there is nothing to show, and nobody looks"
    server.visited.set()
    follower.tick(101.0)
    assert is_watched(run)
    shutil.move(tmp_path / "checkpoints", run / "checkpoints")
    follower.tick(102.0)
    session = server.session
    assert session is not None
    try:
        training = session.state.training
        assert training is not None and training.step == 15 and training.share == 1.0
        assert len(session.restyler.encoders.scene.share) > 1, "the style of now, from few rays"
        before = session.viewed
        saved = checkpoint.load(run / "checkpoints", 15)
        moved = {name: tensor + 1e-3 if tensor.is_floating_point() else tensor for name, tensor in saved.model.items()}
        checkpoint.write(run / "checkpoints", moved, saved.optimizer, step=16, seconds=saved.seconds)
        follower.tick(103.0)
        assert session.viewed is before, "a picture stays for a while"
        follower.tick(111.0)
        until(lambda: session.viewed is not before)
        here, there = (each.scene.render(each.scene.cameras, 0).rgb for each in (before, session.viewed))
        assert not torch.equal(here, there)
        (run / ".watched").unlink()
        session.move_camera("somebody", camera_of(session.viewed.scene, 0))
        follower.tick(112.0)
        assert is_watched(run)
    finally:
        session.__exit__()
