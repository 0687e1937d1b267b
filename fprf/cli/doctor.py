"""`fprf doctor`: what this machine offers, what a method needs, what a scene folder holds, how a run stands.

Each problem names its remedy.
"""

import os
import platform
import shlex
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import chain
from pathlib import Path

from .. import __version__
from ..errors import CheckpointError, ConfigError
from ..plugins import registry
from ..plugins.codec import Missing
from ..plugins.slots import slots
from .findings import Finding, show
from .parsing import parse

_MIB = 1 << 20
_LEAST_DISK = 1 << 30
"""Bytes below which a training may fail for want of room."""
_SHIPPED: dict[str, tuple[str, ...]] = {"encoders": ("content", "semantic"), "decoders": ()}
"""Weights that must be in the package; of decoders any will do."""
_CACHES = (
    (".cache/fprf/weights", "*"),
    (".cache/torch/hub/checkpoints", "vgg19-*.pth"),
    (".cache/huggingface/hub", "models--facebook--dino*"),
)
"""Folders in the user's home, and files in them, where downloaded weights lie."""


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """Settings of `fprf doctor`."""

    target: Path | None = None
    """A run, a scene folder or a method; none = this machine."""
    device: str = "auto"
    """Device of this machine that is tested: cpu, cuda, mps, or auto; not with a target."""
    clean: bool = False
    """Delete the cached feature targets of all scenes; they are made again when needed."""

    def __post_init__(self) -> None:
        if self.target is not None and self.device != "auto":
            raise ConfigError(
                f"device: {self.device} is tested only where no target is given; leave out --device or {self.target}"
            )
        if self.clean and (self.target is not None or self.device != "auto"):
            raise ConfigError(f"clean: only deletes; leave out --clean or {self.target or '--device'}")


def run(args: list[str]) -> int:
    """Print the findings as they come; 1 if something that is needed is wrong."""
    about = (
        "`fprf doctor` looks over this machine and tests its device, `fprf doctor RUN` a run, `fprf doctor DIR` a scene\n"
        "folder, `fprf doctor METHOD` what a method needs here."
    )
    config = parse(DoctorConfig(), args, prog="fprf doctor", description=about, positional=("target",))
    target = config.target
    findings: Iterator[Finding]
    if config.clean:
        from ..training.prepare import cache_folder

        folder = cache_folder() / "features"
        size = _size(folder)
        shutil.rmtree(folder, ignore_errors=True)
        findings = iter([Finding("features", f"{(size - _size(folder)) / _MIB:.0f} MiB deleted in {folder}")])
    elif target is None:
        findings = chain(machine(), self_test(config.device))
    elif (target / "config.json").is_file():
        findings = run_folder(target)
    elif str(target) in registry.installed("fprf.methods"):
        findings = method_needs(str(target))
    else:
        from .doctor_scene import scene_folder

        findings = scene_folder(target)
    return int(show(findings))


def machine() -> Iterator[Finding]:
    """Versions, processors, accelerators, optional packages, weights, plug-ins."""
    yield Finding("fprf", f"{__version__}, Python {platform.python_version()}, {platform.platform()}")
    # Packages that pyproject.toml requires, without importing them.
    for requirement in requires("fprf") or ():
        name = requirement.split(";")[0].split("<")[0].split(">")[0].split("=")[0].strip()
        extra = requirement.partition("extra == ")[2].strip("\"'")
        if extra in ("test", "dev"):
            continue
        if found := _version(name):
            yield Finding(name, found)
        else:
            remedy = f'pip install "fprf[{extra}]"' if extra else f"pip install '{requirement}'"
            yield Finding(name, f"not installed{f' (extra {extra})' if extra else ''}", remedy, optional=bool(extra))
    try:
        yield from _devices()
    except Exception as error:  # a broken installation is a finding, not a crash
        yield Finding("torch", f"{type(error).__name__}: {error}", "pip install --force-reinstall torch")
    from ..datamanagers.features import CACHED_BYTES
    from ..training.prepare import cache_folder

    yield from speed(os.environ)
    free = shutil.disk_usage(Path.cwd()).free
    clean = "fprf doctor --clean    # deletes feature targets, which are made again when needed"
    yield Finding("disk", f"{free / 1024**3:.1f} GiB free here", clean if free < _LEAST_DISK else "")
    folder, most = cache_folder() / "features", 2 * CACHED_BYTES / _MIB  # content and semantics
    yield Finding("features", f"{_size(folder) / _MIB:.0f} MiB of at most {most:.0f} in {folder}; --clean deletes them")
    # Networks that ship with the package, and those that were downloaded.
    for kind, names in _SHIPPED.items():
        weights = Path(__file__).parents[1] / "plugins" / kind / "weights"
        there = sorted(path.stem for path in weights.glob("*.safetensors"))
        absent = [name for name in names if name not in there] or (["any"] if not there else [])
        listed = ", ".join(there) or "none"
        remedy = "pip install --force-reinstall --no-deps fprf" if absent else ""
        yield Finding(kind, f"in the package: {listed}" + (f"; absent: {', '.join(absent)}" if absent else ""), remedy)
    cached = [path.name for place, pattern in _CACHES for path in sorted((Path.home() / place).glob(pattern))]
    yield Finding("cached", ", ".join(cached) or "no downloads yet")
    count = sum(len(registry.installed(group)) for group in registry.groups())
    yield Finding("plug-ins", f"{count} installed; `fprf plugins --check` loads each")
    for complaint in registry.unreadable():
        yield Finding("plug-ins", complaint, "reinstall or uninstall that package")


def _devices() -> Iterator[Finding]:
    """Processor and accelerators, as torch sees them."""
    import torch

    yield Finding("processor", f"{platform.machine()}, {_cores()} cores usable, {torch.get_num_threads()} threads")
    if torch.cuda.is_available():
        for at in range(torch.cuda.device_count()):
            device = torch.cuda.get_device_properties(at)
            yield Finding(f"cuda:{at}", f"{device.name}, {device.total_memory / 1024**3:.0f} GiB")
    elif torch.backends.mps.is_available():
        yield Finding("mps", "Apple GPU")
    else:
        yield Finding("accelerator", "none: `--device auto` takes the processor")


def self_test(name: str) -> Iterator[Finding]:
    """Report a device's kernels and precision, and compare a tiny training step, render and restyle on it with the CPU's.

    Raises PluginError for a device that is not here.
    """
    from ..training.device_check import compare, fast_paths
    from ..training.prepare import device_of

    device = device_of(name)
    yield Finding("device", f"`--device {name}` is {device}")
    remedy = f"train and render with --device cpu; update torch and the driver of {device}"
    start = time.perf_counter()
    try:
        for what, found in fast_paths(device):
            yield Finding(what, found)
        outcomes = compare(device)
    except Exception as error:
        yield Finding("self-test", f"{device} fails: {type(error).__name__}: {(str(error).splitlines() or [''])[0]}", remedy)
        return
    wrong = [f"{each.what} is off by {each.error:.2g}, {each.allowed:g} is allowed" for each in outcomes if not each.right]
    if wrong:
        yield Finding("self-test", f"{device} differs from the CPU: {'; '.join(wrong)}", remedy)
        return
    worst = max(outcomes, key=lambda each: each.error / each.allowed)
    figure = f"at worst the {worst.what} is off by {worst.error:.1g}, {worst.allowed:g} is allowed"
    names = ", ".join(each.what for each in outcomes)
    yield Finding("self-test", f"{names} as on the CPU: {figure}; {time.perf_counter() - start:.1f} s")


def speed(environment: Mapping[str, str]) -> Iterator[Finding]:
    """Causes of a slow machine: fewer threads than cores, other programs, a GPU that torch misses."""
    cores = _cores()
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        threads = environment.get(name, "")
        if threads.isdecimal() and int(threads) < cores:
            yield Finding("threads", f"{name}={threads}, {cores} cores are usable", f"unset {name}", optional=True)
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if busy > cores + 1:
        finding = f"{busy:.0f} programs want the {cores} cores: everything here takes that much longer"
        yield Finding("load", finding, "top    # and end what is not needed", optional=True)
    if Path("/proc/driver/nvidia/version").is_file() and "+cpu" in _version("torch"):
        remedy = "pip install --force-reinstall torch --index-url https://download.pytorch.org/whl/cu126"
        yield Finding("cuda", "an NVIDIA GPU is here, but torch was built without CUDA", remedy, optional=True)


def method_needs(name: str) -> Iterator[Finding]:
    """Packages and weights that training by a method needs. Raises PluginError for a method that cannot be loaded."""
    from ..plugins.codec import method_config

    config = method_config(name)
    for need in config.needs():
        later = ", is downloaded when it is needed" if need.downloaded else " is missing"
        yield Finding("needs", need.what + later, need.remedy, optional=need.downloaded)
    filled = (f"{slot.path} {registry.name_of(slot.kind.group, type(slot.value))}" for slot in slots(config) if slot.value)
    yield Finding("method", f"{name}: {', '.join(filled)}")
    yield Finding("next", f"fprf train {name} --data FOLDER")


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _version(package: str) -> str:
    """Installed version; empty where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def run_folder(folder: Path) -> Iterator[Finding]:
    """Config, progress, plug-ins and what was computed of a run. Raises ConfigError where its config cannot be read."""
    from ..plugins.codec import load_config
    from ..training import checkpoint
    from ..training.run import read_history

    config, method = load_config(folder / "config.json")
    yield Finding("run", f"method {method}, scene {config.data}, {config.steps} steps asked for")
    steps = checkpoint.steps(folder / "checkpoints")
    again = f"fprf train {shlex.quote(str(folder / 'config.json'))} --output {shlex.quote(str(folder))}"
    if not steps:
        yield Finding("checkpoints", "none is complete", again)
    else:
        short = steps[-1] < config.steps and config.minutes is None
        yield Finding("checkpoints", f"step {steps[-1]} of {config.steps}", again if short else "", optional=True)
    for slot in slots(config):
        if isinstance(slot.value, Missing):
            package = slot.value.package or "the package that provides it"
            remedy = f"install {package}, or choose another with --{slot.path} NAME; rendering goes on without it"
            yield Finding("plug-ins", slot.value.reason, remedy, optional=slot.path.endswith("encoder"))
    for name, use in (("scene.json", "rendering"), ("style.safetensors", "restyling")):
        there = (folder / name).is_file()
        yield Finding(name, "there" if there else f"absent; {use} needs it", "" if there else again)
    measure = f"fprf eval {shlex.quote(str(folder))}"
    measured = (folder / "metrics.json").is_file()
    yield Finding("metrics", "there" if measured else "not measured yet", "" if measured else measure, True)
    # Notes of the training: skipped steps, damaged checkpoints.
    events, notes = folder / "events.jsonl", list[str]()
    if events.is_file():
        with suppress(CheckpointError):
            notes = [note for history in read_history(folder) for note in history.notes]
    if notes:
        more = f" and {len(notes) - 1} more" if len(notes) > 1 else ""
        yield Finding("events", notes[-1] + more, f"read {shlex.quote(str(events))}", True)
    yield Finding("size", f"{_size(folder) / _MIB:.1f} MiB")
