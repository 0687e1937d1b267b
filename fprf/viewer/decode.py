"""The process that decodes photographs for `viewer.intake`: a line of JSON in, a line out, until its input ends.

Memory beyond `ROOM` bytes is refused by the system, so a file that unpacks to more fails here and harms nobody.
"""

import json
import os
import sys
from pathlib import Path
from typing import TextIO

__all__ = ["ROOM", "confine", "serve"]

ROOM = 2 << 30
"""Bytes on top of what the process has at its start: 1e8 pixels take 0.3 GB, and some copies."""


def confine(room: int) -> None:
    """Take no more than `room` bytes of address space beyond what is mapped now; does nothing where systems cannot."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + room,) * 2)
    except (ImportError, OSError, ValueError):  # no such limit here: the limits on bytes and pixels remain
        return


def serve(questions: TextIO, answers: TextIO) -> None:
    """{"source", "target", "side"} each; {"said": "ok" or what is wrong} each."""
    from ..errors import FprfError

    for line in questions:
        try:
            asked = json.loads(line)
            _decode(Path(asked["source"]), Path(asked["target"]), int(asked["side"]))
            said = "ok"
        except FprfError as fault:
            # The file's own name means nothing to the one who sent it.
            said = str(fault).removeprefix(f"{asked['source']}: ")
        except Exception as fault:  # whatever a decoder does with a stranger's bytes
            said = f"cannot be decoded ({type(fault).__name__}); export it again, or make it smaller"
        answers.write(json.dumps({"said": said}) + "\n")
        answers.flush()


def _decode(source: Path, target: Path, side: int) -> None:
    """The photograph as a PNG with sides of at most `side` pixels."""
    import cv2

    from ..datamanagers.images import load_image

    photo = load_image(source, upright=True)
    height, width = photo.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    target.write_bytes(cv2.imencode(".png", cv2.cvtColor(small, cv2.COLOR_RGB2BGR))[1].tobytes())


if __name__ == "__main__":
    import cv2  # noqa: F401  what it maps does not count against the room

    confine(ROOM)
    serve(sys.stdin, sys.stdout)
