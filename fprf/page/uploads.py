"""Files that pages send: photographs for a scene that is open, and the files that a scene is made of.

A photograph is checked by its first bytes, then decoded by a process of its own. The result is a PNG that we
wrote ourselves, of bounded size, in a folder of ours under a name of ours. The decoder is started once and
kept, since starting it takes longer than decoding. Its memory is limited; one that takes too long is
replaced.

Files of a scene come in pieces. A piece is one request: the server's limits on bodies hold, and a file may be
of any size. A file is checked by its first bytes before any of it is written, and has its name only when it
is whole.
"""

import io
import json
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
import time
import zipfile
import zlib
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple, TypeAlias

from ..datamanagers.image_files import kind_of
from ..datamanagers.images import IMAGE_SUFFIXES
from ..datamanagers.parsers.config import recognise
from ..errors import DataError, FprfError, UsageError
from ..io.video_reader import VIDEO_SUFFIXES
from ..plugins.captures import endings, format_name

MAX_BYTES = 20 << 20
"""Bytes of a photograph."""
MAX_SIDE = 1024
"""Longest side of what is kept of one: scenes' views are hardly larger."""
_MAX_DECODING_SECONDS = 30.0
"""Seconds of the processor for one photograph, the start of the decoder included; by eye. On a machine that does
other work it may take as long as it needs.
"""
_MAX_IDLE_SECONDS = 60.0
"""Seconds in which a decoder must have had the processor at all; by eye."""
_LOOK_SECONDS = 0.2
"""Between looks at how much it has had."""
_MAX_DECODER_BYTES = 2 << 30
"""Bytes beyond what the decoder has at its start: 1e8 pixels take 0.3 GB, and some copies."""
_MAX_ANSWER_BYTES = 4096
"""Bytes of what the decoder says; it is one sentence."""
_MAX_NAME_CHARACTERS = 48
"""Characters of a name that is shown."""


def check_photograph(data: bytes, name: str = "photograph") -> None:
    """Raise DataError for what is no photograph by its first bytes, or has too many. Its pixels are counted
    by the decoder.
    """
    if len(data) > MAX_BYTES:
        raise DataError(f"{name}: {len(data)} bytes; at most {MAX_BYTES} are taken: make it smaller")
    if not kind_of(data[:64]):
        raise DataError(f"{name}: no PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF; convert it to one of these")


def shown_name(text: str) -> str:
    """The last part of the file name that a browser gave, with plain characters alone, at most 48 of them."""
    last = text.replace("\\", "/").rsplit("/", 1)[-1]
    plain = "".join(c if c.isalnum() or c in " ._-()+" else "_" for c in last if c.isprintable()).strip(" .")
    if len(plain) > _MAX_NAME_CHARACTERS:
        plain = f"{plain[: _MAX_NAME_CHARACTERS - 12]}…{plain[-11:]}"
    return plain or "photograph"


class Uploads:
    """The folder of uploaded photographs and the decoder; both go with `close`."""

    def __init__(self, timeout: float = _MAX_DECODING_SECONDS) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="fprf-view-")
        self.folder = Path(self._folder.name)
        self._timeout = timeout
        self._lock = threading.Lock()
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._count = 0

    def start_decoder(self) -> None:
        """Start the decoder, so that the first photograph need not wait for it."""
        with self._lock:
            self._started()

    def store(self, data: bytes) -> Path:
        """Decode a photograph and write it as a PNG. Raises DataError for what cannot be decoded."""
        check_photograph(data)
        with self._lock:
            self._count += 1
            source = self.folder / f"{self._count:04d}.part"
            target = self.folder / f"{self._count:04d}.png"
            source.write_bytes(data)
            try:
                pipe = self._started()
                # Bytes and no pickles: whatever a photograph made of the decoder, its answer is text here.
                pipe.send_bytes(json.dumps([str(source), str(target)]).encode())
                answer = self._waited(pipe)
                if answer:
                    self._end()
                else:
                    answer = pipe.recv_bytes(_MAX_ANSWER_BYTES).decode(errors="replace")
            except (OSError, EOFError):  # it died over this one
                answer = "cannot be decoded; export it again, or make it smaller"
                self._end()
            finally:
                source.unlink(missing_ok=True)
        if answer:
            raise DataError(f"photograph: {answer}")
        return target

    def _waited(self, pipe: Connection) -> str:
        """Wait until the decoder answers; return why it never will, else an empty text."""
        assert self._process is not None  # by `_started`
        begun = processor_seconds(self._process.pid)
        used = begun
        idle = 0.0
        while not pipe.poll(_LOOK_SECONDS):
            before = used
            used = processor_seconds(self._process.pid)
            # Counted by looks and not by the clock, which goes on where this process too is held up.
            if used > before:
                idle = 0.0
            else:
                idle += _LOOK_SECONDS
            if used - begun > self._timeout:
                return f"not decoded within {self._timeout:g} s of the processor; export it again"
            if idle > _MAX_IDLE_SECONDS:
                return f"its decoder has stood still for {idle:.0f} s; try again"
        return ""

    def close(self) -> None:
        """End the decoder and remove the folder."""
        with self._lock:
            self._end()
            self._folder.cleanup()

    def _started(self) -> Connection:
        """The pipe to the decoder, which is started where none runs."""
        if self._process is None or self._pipe is None or not self._process.is_alive():
            self._end()
            context = multiprocessing.get_context(
                "spawn"
            )  # a fork would carry this process's threads and models
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=decode_photographs, args=(theirs,), daemon=True)
            self._process.start()
            theirs.close()
        return self._pipe

    def _end(self) -> None:
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
            self._pipe.close()
        self._process = None
        self._pipe = None


def processor_seconds(process: int | None) -> float:
    """Seconds of the processor that a process has had so far; where the system does not tell, those of the clock."""
    try:
        # Behind the name in brackets, which may hold spaces: times in the program and in the kernel, in ticks.
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError):
        return time.monotonic()


def limit_memory(room: int) -> None:
    """Limit this process to `room` bytes of address space beyond what is mapped now, on systems that can."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + room,) * 2)
    except (ImportError, OSError, ValueError):  # no such limit here: those on bytes and pixels remain
        return


def decode_photographs(pipe: Connection) -> None:
    """Answer each [source, target] by what is wrong with it, empty once the target is written, until the pipe
    is closed.
    """
    from ..datamanagers.images import load_preview
    from ..io.images import encode

    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # an interrupt at the terminal is the viewer's, which ends this one
    limit_memory(_MAX_DECODER_BYTES)  # what is imported does not count
    while True:
        try:
            source, target = json.loads(pipe.recv_bytes())
        except EOFError:
            return
        try:
            Path(target).write_bytes(encode(load_preview(Path(source), MAX_SIDE), "png"))
            said = ""
        except FprfError as fault:
            said = str(fault).removeprefix(f"{source}: ")  # the file's own name means nothing to the client
        except Exception as fault:  # whatever a decoder raises over a stranger's bytes
            said = f"cannot be decoded ({type(fault).__name__}); export it again, or make it smaller"
        pipe.send_bytes(said.encode(errors="replace")[:_MAX_ANSWER_BYTES])


SourceKind: TypeAlias = Literal["run", "capture", "scene", "photographs", "video"]
_MIN_POSED_PHOTOGRAPHS = 3
"""Photographs that poses can be found for."""
_COLMAP_FILES = frozenset({"cameras", "images", "points3D", "rigs", "frames"})
"""Files of a COLMAP model, without their endings .bin and .txt."""
_VIDEO_PARTS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
"""Kinds of the first part of an MP4 or QuickTime file."""
_MAX_SCENE_FILES = 4000
"""Files of a scene; by eye: more than are trained in a sitting."""
_MAX_SCENE_BYTES = 16 << 30
"""Bytes of all files of a scene; by eye."""
_MIN_FREE_BYTES = 1 << 30
"""Bytes of the disk that are left free."""
_MAX_FOLDER_DEPTH = 6
"""Folders within each other; by eye."""
_MAX_PART_CHARACTERS = 120
"""Characters of a part of a path: file systems take 255 bytes."""
_MAX_STYLE_FILES = 40
"""Files of a style: its photographs and their masks."""
_MAX_STYLE_BYTES = 64 << 20
"""Bytes of all files of a style, unpacked."""
_LAST_LINE_BYTES = 4096
"""Bytes of the end of events.jsonl that hold its last line."""


class Source(NamedTuple):
    """Kind of source that a scene is made of."""

    kind: SourceKind
    """`scene` = photographs with their poses."""
    path: Path


def _kinds() -> str:
    from ..splats.files.base import format_of  # imports torch

    readable = sorted(ending for ending in endings() if format_of(Path(f"x{ending}")).reads)
    return f"photographs, a video, or a capture of 3D Gaussians ({' '.join(readable)})"


def is_capture(path: Path) -> bool:
    """True for a path that is named like a capture of 3D Gaussians."""
    if format_name(path) is not None:
        return True
    return (path / "meta.json").is_file() or (path / "lod-meta.json").is_file()


def newest_step(run: Path) -> int:
    """Step of the newest whole checkpoint; -1 where there is none."""
    steps = (path.parent.name.removeprefix("step-") for path in run.glob("checkpoints/step-*/manifest.json"))
    return max((int(step) for step in steps if step.isdigit()), default=-1)


def training_progress(root: Path) -> dict[str, Any] | None:
    """Progress of a run, by the last line of its events.jsonl: step, share, psnr, seconds left; None where it
    does not say.
    """
    try:
        with (root / "events.jsonl").open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - _LAST_LINE_BYTES))
            # The first line of the tail may be cut off; events without a share tell nothing of progress.
            lines = []
            for line in file.read().decode(errors="replace").splitlines()[1:]:
                lines.append(json.loads(line))
        last = next(line for line in reversed(lines) if "share" in line)
        # As long again for each share that is left, at the speed so far.
        left = last["seconds"] * (1 - last["share"]) / max(last["share"], 1e-3)
        return {
            "step": int(last["step"]),
            "share": last["share"],
            "psnr": float(last["psnr"]),
            "seconds_left": round(left),
        }
    except (OSError, ValueError, KeyError, StopIteration):
        return None


def find_source(path: Path) -> Source:
    """Return the kind of a file or folder, by names alone. Raises DataError where no scene can be made of
    it.
    """
    if (path / "config.json").is_file():
        return Source("run", path)
    if is_capture(path):
        return Source("capture", path)
    if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
        return Source("video", path)
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    if not path.is_dir():
        raise DataError(f"{path}: no scene can be made of it; give {_kinds()}")
    files = []
    for each in path.rglob("*"):
        if each.is_file() and not each.name.startswith("."):
            files.append(each)
    # Photographs with poses need no `fprf process`, whatever else lies beside them.
    try:
        recognise(path)
        return Source("scene", path)
    except DataError:
        pass  # its photographs have no poses
    # Several photographs are a scene; a single video or capture is one where no photographs say otherwise.
    photographs = []
    for each in files:
        if each.suffix.lower() in IMAGE_SUFFIXES:
            photographs.append(each)
    if len(photographs) >= _MIN_POSED_PHOTOGRAPHS:
        return Source("photographs", path)
    kinds: tuple[tuple[SourceKind, list[Path]], ...] = (
        ("capture", [each for each in files if format_name(each) is not None]),
        ("video", [each for each in files if each.suffix.lower() in VIDEO_SUFFIXES]),
    )
    for kind, single in kinds:
        if len(single) == 1 and not photographs:
            return Source(kind, single[0])
        if len(single) > 1:
            some = ", or ".join(path.name for path in single[:3])
            raise DataError(f"{len(single)} {kind}s; a scene is made of one: give {some}")
    if photographs:
        if len(photographs) == 1:
            few = "1 photograph is"
        else:
            few = f"{len(photographs)} photographs are"
        raise DataError(
            f"{few} no scene: take at least {_MIN_POSED_PHOTOGRAPHS}, better 20 to 60, from places around it"
        )
    raise DataError(f"{path.name}: nothing that a scene can be made of; give {_kinds()}")


def check_file(name: str, head: bytes, size: int) -> None:
    """Raise DataError for a file that no scene is made of, by its name, its first bytes and its size."""
    from ..splats.files.base import format_of

    suffix = Path(name).suffix.lower()
    stem = Path(name).stem
    if suffix in IMAGE_SUFFIXES:
        check_photograph(head, name)
        return
    # Poses and descriptions of captures in parts are JSON alike; any other capture is known by its format.
    capture = suffix != ".json" and format_name(Path(name)) is not None and format_of(Path(name)).reads
    # What each ending must begin with; one that is not in here is not taken.
    whole = {
        **({suffix: format_of(Path(name)).recognises(head, size)} if capture else {}),
        ".npz": head.startswith(b"PK"),
        ".npy": head.startswith(b"\x93NUMPY"),
        ".json": head.lstrip()[:1] in (b"{", b"["),
        **dict.fromkeys(VIDEO_SUFFIXES, _begins_video(head)),
        **dict.fromkeys((".bin", ".txt") if stem in _COLMAP_FILES else (), True),
    }
    if suffix not in whole:
        raise DataError(f"{name}: cannot become a scene; give {_kinds()}")
    if not whole[suffix]:
        raise DataError(f"{name}: damaged, or no {suffix} file; export it again")


def _is_plain(part: str) -> bool:
    """True for a part of a path that is a plain name on every system."""
    if not part.isprintable() or part.startswith("."):
        return False
    return not {*part} & {*'\\:*?"<>|'} and len(part) <= _MAX_PART_CHARACTERS


def _begins_video(head: bytes) -> bool:
    """True for the first bytes of MP4, QuickTime, AVI, Matroska, an MPEG program or transport stream."""
    if (
        head[4:8] in _VIDEO_PARTS
        or head[8:11] == b"AVI"
        or head.startswith((b"\x1aE\xdf\xa3", b"\0\0\1\xba"))
    ):
        return True
    # Packets of a transport stream begin with G, those of cameras after a time of four bytes.
    return b"G" in (head[:1], head[4:5])


def unpack_style(data: bytes, folder: Path) -> Path:
    """Write a style.json and its photographs, of a .zip or of a style.json alone, into a folder that is made;
    return the style.json. Raises DataError for anything else.
    """
    folder.mkdir(parents=True)
    path = folder / "style.json"
    if not data.startswith(b"PK"):
        path.write_bytes(data)
        return path
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            rows = [row for row in archive.infolist() if not row.is_dir()]
            if len(rows) > _MAX_STYLE_FILES or sum(row.file_size for row in rows) > _MAX_STYLE_BYTES:
                limits = f"at most {_MAX_STYLE_FILES} files of {_MAX_STYLE_BYTES >> 20} MiB in all"
                raise DataError(f"style: {len(rows)} files; {limits}")
            for row in rows:
                # Names without folders: nothing leads out of this one.
                name = PurePosixPath(row.filename.replace("\\", "/")).name
                if _is_plain(name):
                    (folder / name).write_bytes(archive.read(row))
    except (zipfile.BadZipFile, OSError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise DataError(f"style: no .zip that can be read ({error})") from error
    if not path.is_file():
        raise DataError("style: no style.json is in this .zip; give one that was saved here")
    return path


class SceneFiles:
    """Receives the files of one scene into `folder`, which is made with the first of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files = 0
        self._bytes = 0
        self._lock = threading.Lock()

    def add(self, name: str, at: int, size: int, data: bytes) -> None:
        """Take the piece of a file of `size` bytes that begins at byte `at`; pieces come in their order.

        Raises UsageError for a name that leads elsewhere and for a piece out of order, DataError for what is
        not taken.
        """
        # The name leads to a place below the folder, by parts that are plain names on every system.
        parts = PurePosixPath(name).parts
        plain = all(_is_plain(part) for part in parts)
        if not parts or not plain or name.startswith("/") or len(parts) > _MAX_FOLDER_DEPTH:
            raise UsageError(f"{name[:80]!r}: no name of a file in a folder; rename it")
        path = self.folder.joinpath(*parts)
        part = path.with_name(f"{path.name}.part")
        with self._lock:
            if at == 0:
                check_file(path.name, data, size)
                if self._files >= _MAX_SCENE_FILES or self._bytes + size > _MAX_SCENE_BYTES:
                    limits = f"at most {_MAX_SCENE_FILES} files of {_MAX_SCENE_BYTES >> 30} GiB in all"
                    raise DataError(f"{path.name}: a scene takes {limits}")
                path.parent.mkdir(parents=True, exist_ok=True)
                if shutil.disk_usage(path.parent).free < size + _MIN_FREE_BYTES:
                    raise DataError(f"{path.name}: the disk of {self.folder} is full; make room there")
                self._files = self._files + 1
                self._bytes = self._bytes + size
                part.unlink(missing_ok=True)
            # Pieces come in their order, so that a file's own size says how far it is.
            written = part.stat().st_size if part.is_file() else 0
            if written != at or at + len(data) > size or (at > 0 and not data):
                raise UsageError(
                    f"{path.name}: a piece at byte {at} of {size}, where {written} are there; send it again"
                )
            with part.open("ab") as file:
                file.write(data)
            # It gets its name when it is whole, in one step.
            if at + len(data) == size:
                os.replace(part, path)
