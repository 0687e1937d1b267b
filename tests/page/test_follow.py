import shutil
from pathlib import Path

import pytest

from fprf.errors import CheckpointError
from fprf.page.server import Access, ViewerServer
from fprf.page.session import TrainingFollower, Viewed, training_progress, view_of_run
from fprf.training.driver import is_watched
from fprf.training.loading import open_run


def test_a_run_is_opened_at_its_first_checkpoint_and_followed(run: Path) -> None:
    newest = max((run / "checkpoints").glob("step-*"))
    hidden = run / "hidden"
    shutil.move(newest, hidden)

    def load() -> Viewed:
        return view_of_run(open_run(run, "cpu"))

    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        follower = TrainingFollower(server, run, load)
        follower.tick()
        assert follower.session is None and not is_watched(run)
        shutil.move(hidden, newest)
        follower.tick()
        session = follower.session
        assert session is not None and session.viewed.step == 15
        follower.tick()
        assert follower.session is session
        server._clients[1] = None  # type: ignore[assignment]  # somebody looks
        follower.tick()
        server._clients.clear()
        assert is_watched(run)


def test_what_cannot_be_opened_is_tried_again_with_the_next_checkpoint(run: Path) -> None:
    def load() -> Viewed:
        raise CheckpointError("damaged")

    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        follower = TrainingFollower(server, run, load)
        with pytest.raises(CheckpointError):
            follower.tick()
        follower.tick()  # not the same one again


def test_progress_is_what_the_last_event_says(run: Path, tmp_path: Path) -> None:
    found = training_progress(run)
    assert found is None or (found["share"] == 1 and found["step"] == 15)
    assert training_progress(tmp_path) is None
