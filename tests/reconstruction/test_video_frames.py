from pathlib import Path

import cv2
import numpy as np
import pytest

from fprf.errors import DataError
from fprf.io.video import write_video
from fprf.reconstruction.images import frame_name, frame_scores, save_frames, sharpness

BLURRED = (1, 2, 5)


def frames(count: int = 8) -> list[np.ndarray]:
    drawn = np.random.default_rng(0)
    base = cv2.resize(drawn.integers(0, 256, (12, 16, 3), dtype=np.uint8), (160, 120), interpolation=cv2.INTER_NEAREST)
    made = []
    for k in range(count):
        frame = np.roll(base, 5 * k, axis=1)
        cv2.putText(frame, str(k), (20, 90), cv2.FONT_HERSHEY_SIMPLEX, 3, (255, 255, 255), 8)
        made.append(cv2.GaussianBlur(frame, (0, 0), 4) if k in BLURRED else frame)
    return made


@pytest.fixture
def video(tmp_path: Path) -> Path:
    write_video(tmp_path / "clip.mp4", frames(), 24, h264=False)
    return tmp_path / "clip.mp4"


def test_scores_tell_blurred_frames(video: Path) -> None:
    seen: list[tuple[int, int]] = []
    scores = frame_scores(video, lambda done, total, what: seen.append((done, total)))
    assert len(scores) == 8 and seen[-1] == (8, 8) and all(done <= total for done, total in seen)
    assert max(scores[k] for k in BLURRED) < 0.5 * min(scores[k] for k in range(8) if k not in BLURRED)


def test_saved_frames_are_those_asked_for(video: Path, tmp_path: Path) -> None:
    save_frames(video, [0, 3, 7], tmp_path / "out", lambda *_: None)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [frame_name(k) for k in (0, 3, 7)]
    for k, truth in enumerate(frames()):
        path = tmp_path / "out" / frame_name(k)
        if path.is_file():
            found = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
            assert np.abs(found.astype(int) - truth).mean() < 12, "coded twice, but the same picture"
            assert sharpness(found) > 0


def test_frames_that_are_there_stay(video: Path, tmp_path: Path) -> None:
    (tmp_path / frame_name(3)).write_bytes(b"mine")
    save_frames(video, [3, 4], tmp_path, lambda *_: None)
    assert (tmp_path / frame_name(3)).read_bytes() == b"mine" and (tmp_path / frame_name(4)).is_file()
    before = (tmp_path / frame_name(4)).stat().st_mtime_ns
    save_frames(tmp_path / "gone.mp4", [3, 4], tmp_path, lambda *_: None)
    assert (tmp_path / frame_name(4)).stat().st_mtime_ns == before


def test_what_is_no_video_is_named(tmp_path: Path, video: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "no.mp4").write_bytes(b"nothing of the kind" * 100)
    with pytest.raises(DataError, match=r"no\.mp4: no video that can be opened"):
        frame_scores(tmp_path / "no.mp4", lambda *_: None)
    with pytest.raises(DataError, match="frame 99 was there before"):
        save_frames(video, [2, 99], tmp_path / "out", lambda *_: None)
