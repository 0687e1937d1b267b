"""`fprf doctor`: what this machine offers, what a method needs, what a scene folder holds.

Each problem names its remedy.
"""

import getpass
import os
import platform
import re
import shlex
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Console
from rich.markup import escape

from .. import __version__
from ..errors import ConfigError, DataError
from ..io.paths import as_path
from ..plugins import registry
from ..plugins.captures import format_name, is_scene
from ..plugins.slots import slots
from .parsing import parse

if TYPE_CHECKING:
    from ..datamanagers.photograph_files import Photographs

_PATH_PATTERN = re.compile(
    r"PATH[^\s;,'\"]*|(?<![\w:/.~])~?/[^\s;,'\"]+|\b[A-Za-z]:\\[^;,'\"]+|\\\\[^\s;,'\"]+"
)
"""Absolute paths in messages, of POSIX and Windows."""
_MIN_NAME_LENGTH = 3
"""Shorter names of users and machines are parts of other words, and tell nobody's."""
_BYTES_PER_MIB = 1 << 20
"""For sizes in messages."""
_MAX_VIDEO_SECONDS = 30.0
"""Time for which a video is read: some minutes of it. By eye."""
_MIN_DISK_BYTES = 1 << 30
"""Free bytes below which a training may fail for want of room: features and checkpoints of a small scene. By eye."""
_MAX_OPENED_VIEWS = 48
"""Views of a scene folder whose files are opened, evenly through the scene: by eye, some seconds."""


class Finding(NamedTuple):
    """One line of the report."""

    what: str
    found: str
    remedy: str = ""
    """The one command or act that mends it; empty where nothing is wrong."""
    optional: bool = False
    """Everything else works without it."""


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """Settings of `fprf doctor`."""

    target: Path | None = None
    """A scene folder, photographs, a video, a capture of 3D Gaussians, or a method; none = this machine."""
    device: str = "auto"
    """Device of this machine that is tested: cpu, cuda, mps, or auto; not with a target."""
    clean: bool = False
    """Delete the cached feature targets of all scenes; they are made again when needed."""
    report: bool = False
    """Print what is found of this machine as text for a report of a fault, without paths and names."""

    def __post_init__(self) -> None:
        if self.report and (self.target is not None or self.clean):
            raise ConfigError(f"report: is of this machine; leave out --report or {self.target or '--clean'}")
        if self.target is not None and self.device != "auto":
            raise ConfigError(
                f"device: {self.device} is tested only where no target is given; leave out --device or {self.target}"
            )
        if self.clean and (self.target is not None or self.device != "auto"):
            raise ConfigError(f"clean: only deletes; leave out --clean or {self.target or '--device'}")


def run(args: list[str]) -> int:
    """Print the findings as they come; 1 if something that is needed is wrong."""
    about = (
        "`fprf doctor` looks over this machine and tests its device, `fprf doctor DIR` a scene folder,\n"
        "`fprf doctor FILE` a capture of 3D Gaussians,\n"
        "`fprf doctor METHOD` what a method needs here. `fprf doctor --report` is for reports of faults."
    )
    config = parse(DoctorConfig(), args, prog="fprf doctor", description=about, positional=("target",))
    target = config.target
    findings: Iterator[Finding]
    if config.clean:
        from ..io.cache import user_folder

        folder = user_folder("features")
        size = _size(folder)
        shutil.rmtree(folder, ignore_errors=True)
        findings = iter(
            [Finding("features", f"{(size - _size(folder)) / _BYTES_PER_MIB:.0f} MiB deleted in {folder}")]
        )
    elif target is None:
        findings = chain(machine(), self_test(config.device))
    elif str(target) in registry.installed("fprf.methods"):
        findings = method_needs(str(target))
    elif is_scene(target) and not (target / "config.json").is_file():
        findings = capture_file(target)
    elif _is_video(target):
        findings = video_file(target)
    else:
        findings = scene_folder(target)
    if config.report:
        print(report_of(findings))
        return 0
    console = Console(highlight=False)
    bad = False
    for finding in findings:
        if not finding.remedy:
            mark = "[green]ok[/]      "
        elif finding.optional:
            mark = "[yellow]optional[/]"
        else:
            mark = "[red]problem[/] "
        bad |= bool(finding.remedy) and not finding.optional
        console.print(f"{mark}  [bold]{escape(finding.what):<14}[/] {escape(finding.found)}", soft_wrap=True)
        if finding.remedy:
            console.print(f"{'':<26} → {escape(finding.remedy)}", soft_wrap=True)
    return int(bad)


def report_of(findings: Iterable[Finding]) -> str:
    """Findings as Markdown for a report of a fault; what is a path, or could name somebody, is left out."""
    lines = []
    for finding in findings:
        if not finding.remedy:
            mark = "ok"
        else:
            mark = "optional" if finding.optional else "problem"
        lines.append(f"{mark:<8}  {finding.what:<14} {without_paths(finding.found)}".rstrip())
    return "\n".join(["```text", *lines, "```"])


def without_paths(text: str) -> str:
    """The text with PATH for each absolute path, and NAME for the names of user and machine."""
    from ..io.cache import user_folder

    # Those that are known as a whole: a space may be in them.
    for folder in (user_folder("features"), Path.cwd(), as_path("~")):
        text = text.replace(str(folder), "PATH")
    text = _PATH_PATTERN.sub("PATH", text)
    for name in (getpass.getuser(), platform.node()):
        if len(name) >= _MIN_NAME_LENGTH:
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", "NAME", text)
    return text


def _is_video(path: Path) -> bool:
    """True for a file that is called as videos are."""
    if not path.is_file():
        return False
    from ..io.video_reader import VIDEO_SUFFIXES

    return path.suffix.lower() in VIDEO_SUFFIXES


def machine() -> Iterator[Finding]:
    """Versions, processors, accelerators, optional packages, room on the disk, plug-ins."""
    yield Finding("fprf", f"{__version__}, Python {platform.python_version()}, {platform.platform()}")
    # Packages that pyproject.toml requires, without importing them.
    for requirement in requires("fprf") or ():
        name = requirement.split(";")[0].split("<")[0].split(">")[0].split("=")[0].strip()
        extra = requirement.partition("extra == ")[2].strip("\"'")
        if extra in ("test", "dev", "docs"):  # of those who change fprf
            continue
        try:
            yield Finding(name, version(name))
        except PackageNotFoundError:
            if extra:
                remedy = f'pip install "fprf[{extra}]"'
            else:
                remedy = f"pip install '{requirement}'"
            yield Finding(
                name, f"not installed{f' (extra {extra})' if extra else ''}", remedy, optional=bool(extra)
            )
    try:
        import torch

        cores = os.cpu_count()
        if hasattr(os, "sched_getaffinity"):
            cores = len(os.sched_getaffinity(0))
        yield Finding(
            "processor", f"{platform.machine()}, {cores} cores usable, {torch.get_num_threads()} threads"
        )
        if torch.cuda.is_available():
            for at in range(torch.cuda.device_count()):
                device = torch.cuda.get_device_properties(at)
                yield Finding(f"cuda:{at}", f"{device.name}, {device.total_memory / 1024**3:.0f} GiB")
        elif torch.backends.mps.is_available():
            yield Finding("mps", "Apple GPU")
        elif Path("/proc/driver/nvidia/version").is_file() and torch.version.cuda is None:
            remedy = "pip install --force-reinstall torch --index-url https://download.pytorch.org/whl/cu126"
            yield Finding(
                "cuda", "an NVIDIA GPU is here, but torch was built without CUDA", remedy, optional=True
            )
        else:
            yield Finding("accelerator", "none: `--device auto` takes the processor")
            if torch.version.cuda is not None and not torch.version.hip:
                found = f"torch is built for CUDA {torch.version.cuda}, and no NVIDIA GPU is here: gigabytes for nothing"
                remedy = (
                    "pip install --force-reinstall torch --index-url https://download.pytorch.org/whl/cpu"
                )
                yield Finding("torch", found, remedy, optional=True)
    except Exception as error:  # a broken installation is a finding, not a crash
        yield Finding("torch", f"{type(error).__name__}: {error}", "pip install --force-reinstall torch")
    from ..datamanagers.features import CACHED_BYTES
    from ..io.cache import cache_home, refusal, user_folder

    free = shutil.disk_usage(Path.cwd()).free
    clean = "fprf doctor --clean    # deletes feature targets, which are made again when needed"
    yield Finding("disk", f"{free / 1024**3:.1f} GiB free here", clean if free < _MIN_DISK_BYTES else "")
    # content and semantics
    folder = user_folder("features")
    reason = refusal(folder)
    if reason:
        if cache_home() is None:
            where = "this user has no home"
        else:
            where = f"{folder}: {reason}"
        found = f"{where}; every command compiles its kernels and encodes images again"
        remedy = (
            "export XDG_CACHE_HOME=FOLDER    # one that can be written to; NUMBA_CACHE_DIR for kernels alone"
        )
        yield Finding("cache", found, remedy, optional=True)
    else:
        size = f"{_size(folder) / _BYTES_PER_MIB:.0f} MiB of at most {2 * CACHED_BYTES / _BYTES_PER_MIB:.0f}"
        yield Finding("features", f"{size} in {folder}; --clean deletes them")
    count = sum(len(registry.installed(group)) for group in registry.groups())
    yield Finding("plug-ins", f"{count} installed; `fprf plugins --check` loads each")
    for complaint in registry.unreadable():
        yield Finding("plug-ins", complaint, "reinstall or uninstall that package")


def self_test(name: str) -> Iterator[Finding]:
    """Report a device's kernels and precision, and compare a tiny training step, render and restyle on it
    with the CPU's.

    Raises PluginError for a device that is not here.
    """
    from ..training.device_check import compare, fast_paths
    from ..training.prepare import device_of

    device = device_of(name)
    yield Finding("device", f"`--device {name}` is {device}")
    # Whatever a kernel or driver does wrong is a finding with a way out, not a traceback.
    remedy = f"train and render with --device cpu; update torch and the driver of {device}"
    start = time.perf_counter()
    try:
        for what, found in fast_paths(device):
            yield Finding(what, found)
        outcomes = compare(device)
    except Exception as error:
        yield Finding(
            "self-test",
            f"{device} fails: {type(error).__name__}: {(str(error).splitlines() or [''])[0]}",
            remedy,
        )
        return
    wrong = []
    for each in outcomes:
        if not each.right:
            wrong.append(f"{each.what} is off by {each.error:.2g}, {each.allowed:g} is allowed")
    if wrong:
        yield Finding("self-test", f"{device} differs from the CPU: {'; '.join(wrong)}", remedy)
        return
    worst = max(outcomes, key=lambda each: each.error / each.allowed)
    figure = f"at worst the {worst.what} is off by {worst.error:.1g}, {worst.allowed:g} is allowed"
    names = ", ".join(each.what for each in outcomes)
    yield Finding("self-test", f"{names} as on the CPU: {figure}; {time.perf_counter() - start:.1f} s")


def method_needs(name: str) -> Iterator[Finding]:
    """Packages and weights that training by a method needs. Raises PluginError for a method that cannot be
    loaded.
    """
    from ..config_files import method_config

    config = method_config(name)
    for need in config.needs():
        if need.downloaded:
            later = ", is downloaded when it is needed"
        else:
            later = " is missing"
        yield Finding("needs", need.what + later, need.remedy, optional=need.downloaded)
    filled = (
        f"{slot.path} {registry.name_of(slot.kind.group, type(slot.value))}"
        for slot in slots(config)
        if slot.value
    )
    yield Finding("method", f"{name}: {', '.join(filled)}")
    yield Finding("next", f"fprf train {name} --data FOLDER")


def _size(folder: Path) -> int:
    try:
        return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    except OSError:  # of a user who may not look into it
        return 0


def scene_folder(data: Path) -> Iterator[Finding]:
    """Format, views, split, north, points and readable images of a scene. Raises DataError where it cannot be
    parsed.
    """
    from ..datamanagers.images import colour_notes, load_images, transparent_fault, useless_masks
    from ..datamanagers.parsers.config import DataParserConfig, parse_scene, recognise
    from ..datamanagers.photograph_files import find_photographs
    from ..datamanagers.positions import NORTH_NOTE
    from ..datamanagers.scene import find_sightings, sparser

    try:
        parser = recognise(data)
    except DataError:
        photographs = None
        if data.is_dir():
            photographs = find_photographs(data)
        if photographs is None or not photographs.files:
            raise
        yield from photographs_without_poses(data, photographs)
        return
    yield Finding("format", registry.name_of(DataParserConfig.group, type(parser)))
    scene = parse_scene(data, 1, parser)
    count = len(scene.paths)
    # A capture of many crops has as many sizes: the first three and a number are told.
    sizes = sorted({(int(w), int(h)) for w, h in scene.cameras.size.tolist()})
    shown = ", ".join(f"{w} x {h}" for w, h in sizes[:3]) + (
        f" and {len(sizes) - 3} more" if len(sizes) > 3 else ""
    )
    lenses = sorted({("pinhole", "OpenCV", "fisheye")[lens] for lens in scene.cameras.lens.tolist()})
    yield Finding("views", f"{count} of {shown} pixels, {' and '.join(lenses)} lens")
    yield Finding("split", f"{len(scene.train)} to train, {len(scene.test)} held out")
    north = "nothing tells it: azimuths of suns count from the direction of the first view"
    for note in scene.notes:
        if note.startswith(NORTH_NOTE):
            north = note.removeprefix(NORTH_NOTE)
            continue
        found_masks, call, remedy = note.partition("; call ")  # masks of which none fits
        if remedy:
            yield Finding("masks", found_masks, (call + remedy).removeprefix("; "))
        else:
            yield Finding("note", note)
    yield Finding("north", north)
    # Points begin the first Gaussians, where training views see them.
    if scene.points is None or not len(scene.points):
        yield Finding(
            "points", "none; bounds come from the cameras, first Gaussians from matches between views"
        )
    else:
        sightings = find_sightings(sparser(scene))
        if sightings is None:
            seeing = 0
        else:
            seeing = len({*sightings.view.tolist()})
        found = f"{len(scene.points)} of the reconstruction, in view of {seeing} of {len(scene.train)} training views"
        if seeing:
            remedy = ""
        else:
            remedy = "remove them, or give those of this scene: they lie elsewhere or behind"
        yield Finding("points", found, remedy, optional=True)
    if fault := useless_masks(scene):
        found, _, remedy = fault.partition("; ")
        yield Finding("masks", found, remedy, optional="are white" in found)
    # Decoding all of a large capture takes minutes: views evenly through it stand for the others.
    broken = []
    for view in range(0, count, -(-count // _MAX_OPENED_VIEWS)):
        try:
            load_images(scene, views=[view])
            clear = transparent_fault(scene.paths[view])
        except DataError as fault:
            broken.append(str(fault))
        else:
            broken += [clear] if clear else []
    for note in colour_notes(scene.paths):
        yield Finding("colours", note)
    if broken:
        if len(broken) > 1:
            more = f" and {len(broken) - 1} more"
        else:
            more = ""
        yield Finding("images", f"{broken[0]}{more}", "replace them, or remove their poses")
    yield Finding("next", f"fprf train --data {shlex.quote(str(data))}")


def capture_file(path: Path) -> Iterator[Finding]:
    """Format, Gaussians, what points up and how numbers are meant of a capture. Raises DataError where it
    cannot be read.
    """
    from ..splats.capture_alignment import axes_of
    from ..splats.files import read_capture
    from ..splats.ground import axis_name

    capture = read_capture(path)
    gaussians = capture.gaussians
    yield Finding("format", format_name(capture.path) or "")
    faults = gaussians.faults()
    said = ", ".join([f"{len(gaussians)}, harmonics of degree {gaussians.degree}", *faults])
    if faults:
        remedy = "they are left out of what is drawn; export the capture again"
    else:
        remedy = ""
    yield Finding("gaussians", said, remedy, optional=True)
    axes = axes_of(capture)
    yield Finding("up", f"{axis_name(axes.up)}: {axes.reason}; --up says otherwise")
    if capture.north is not None:
        yield Finding("north", f"{axis_name(capture.north.direction)}: {capture.north.source}")
    # The last note of a capture that looks activated says that, too.
    for note in capture.notes[: -1 if capture.activation else None]:
        yield Finding("note", note)
    if capture.activation:
        found = f"{capture.activation}, as if activated already"
        yield Finding("numbers", found, f"fprf restyle {shlex.quote(str(path))} --activated true ...")
    yield Finding("next", f"fprf restyle {shlex.quote(str(path))} --references PHOTO.jpg --output NEW.ply")


def photographs_without_poses(data: Path, photographs: "Photographs") -> Iterator[Finding]:
    """Tell what `fprf process` will take of a folder, and what it will leave out."""
    from ..datamanagers.photograph_files import COPIES, equal_files, equal_pictures, left_out_note, shown_name

    files = photographs.files
    # Copies in another encoding are told where few are decoded; processing decodes all.
    if len(files) <= _MAX_OPENED_VIEWS:
        copies = equal_pictures(files)
    else:
        copies = equal_files(files)
    yield Finding("format", "photographs without poses")
    yield Finding("images", f"{len(files) - len(copies)} photographs")
    notes = photographs.notes()
    if copies:
        names = sorted(shown_name(path.relative_to(data)) for path in copies)
        notes.append(left_out_note(COPIES, names))
    for note in notes:
        yield Finding("note", note)
    yield from lenses_of(data, files)
    yield Finding("next", f"fprf process {shlex.quote(str(data))}")


def lenses_of(data: Path, files: Sequence[Path]) -> Iterator[Finding]:
    """Tell what the photographs of a folder say of their lenses."""
    from ..datamanagers.image_files import read_header
    from ..reconstruction.images import read_encoder, read_lens
    from ..reconstruction.lenses import unsaid_sentence

    images = {}
    for path in files:
        with suppress(DataError):  # of what cannot be read another line tells
            header = read_header(path)
            images[path.relative_to(data).as_posix()] = {
                "width": header.width,
                "height": header.height,
                "lens": read_lens(path),
                "encoder": read_encoder(path),
            }
    if told := unsaid_sentence(images):
        yield Finding("lenses", told)


def video_file(path: Path) -> Iterator[Finding]:
    """Tell how much of a video can be read, and what becomes of its colours and pixels. Raises
    DataError where it cannot be opened.
    """
    from ..io.video_reader import read_video

    log, frames = read_video(path)
    start = time.perf_counter()
    whole = True
    for frame in frames:
        if log.read == 1:
            height, width = frame.picture().shape[:2]
            yield Finding("format", f"video of {width} x {height} pixels")
        if time.perf_counter() - start > _MAX_VIDEO_SECONDS:
            whole = False
            break
    if not log.read:
        remedy = "convert it to H.264 in an .mp4, or copy it from the camera again"
        yield Finding("frames", "none can be decoded", remedy)
        return
    if whole:
        if log.missing:
            remedy = "copy it from the camera again; what can be read is used"
        else:
            remedy = ""
        yield Finding("frames", log.sentence(), remedy, optional=True)
    else:
        yield Finding(
            "frames", f"the first {log.read} of {log.expected} were read, {log.damaged} cannot be decoded"
        )
    for note in log.notes:
        yield Finding("note", note)
    yield Finding("next", f"fprf process {shlex.quote(str(path))}")
