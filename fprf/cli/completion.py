"""Completion of the command line: scripts for shells, and the words that they ask for.

A script calls `fprf --complete --word=WORD WORD ...` with the words before the cursor; what is printed, a line each,
may stand in the place of WORD. Nothing printed means a file. Plug-ins, methods, runs, views and regions are looked up
as they are now; nothing heavy is imported.
"""

import enum
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin

from safetensors import SafetensorError, safe_open

from ..errors import FprfError, UsageError
from ..io.paths import as_path
from ..plugins.codec import read_json
from ..plugins.registry import installed
from ..plugins.slots import slots
from ..style.config import PRESETS, StyleConfig
from .parsing import COMPLETING, Completing, Flag, flags_of
from .verbs import VERBS, packaged, run_packaged, verb_module

SHELLS = {"bash": "bash", "zsh": "zsh", "fish": "fish", "powershell": "ps1"}
"""Shells with the endings of their scripts."""
_WORD = "--word="
_REGION_FLAGS = ("pin", "forbid", "keep", "region_strength")
"""Fields whose values begin with a region."""
_REGION_VALUE = ("pin", "forbid", "region_strength")
"""Those of them that go on with `=`."""
_KEY_TABLES = ("keys", "style.keys")
"""Tables with a row for each region in style.safetensors, of fields and of Gaussians."""
_DEVICES = ("auto", "cpu", "cuda", "mps")
_RUN_FIELDS = ("run",)
"""Fields that name a run folder."""
_VIEW_FIELDS = ("views", "view")
"""Fields that name captured views."""


def install(shell: str) -> str:
    """Write the script of a shell to where it looks for it, or to a folder of ours. Returns what to do next.

    An empty name is the shell of the environment. Raises UsageError for a shell that there is no script for.
    """
    name = shell or Path(os.environ.get("SHELL", "")).name
    text = script(name)
    home = as_path("~")
    data = Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share")
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    if name == "fish":
        place = config / "fish" / "completions" / "fprf.fish"
        then = "open another shell"
    elif name == "bash":
        place = data / "bash-completion" / "completions" / "fprf"
        then = (
            f"open another shell; where bash-completion is not installed, add to ~/.bashrc: source '{place}'"
        )
    else:
        place = data / "fprf" / f"completion.{SHELLS[name]}"
        profile = "~/.zshrc, after compinit: source" if name == "zsh" else "$PROFILE: ."
        then = f"add to {profile} '{place}'"
    from ..io.atomic import write_text

    place.parent.mkdir(parents=True, exist_ok=True)
    write_text(place, text)
    return f"{place} is written; {then}"


def script(shell: str) -> str:
    """The script of a shell. Raises UsageError where there is none."""
    if shell not in SHELLS:
        raise UsageError(f"completion: {shell or 'the shell'} is not known; name one of {', '.join(SHELLS)}")
    return (files(__package__) / "completions" / f"fprf.{SHELLS[shell]}").read_text("utf-8")


def complete(args: Sequence[str]) -> list[str]:
    """The words that may stand in the place of the one that is being written; none where files are meant, and where
    what is there already is wrong.
    """
    word = ""
    words = []
    for arg in args:
        if arg.startswith(_WORD) and not word:
            word = arg.removeprefix(_WORD)
        else:
            words.append(arg)
    # Shells that part words at equals signs give them alone.
    words = [each for each in words if each != "="]
    found = []
    with suppress(FprfError, OSError, SafetensorError):
        for each in _candidates(words, word):
            if each.startswith(word):
                found.append(each)
    return list(dict.fromkeys(found))


def _candidates(words: Sequence[str], word: str) -> Iterator[str]:
    """Whatever may come after the words, whether it begins with `word` or not."""
    if not words:
        yield from (*VERBS, *packaged(), "--help", "--version", "--install-completion", "--show-completion")
        return
    verb = words[0]
    if words in (["--install-completion"], ["--show-completion"]):
        yield from SHELLS
        return
    first = len(words) == 1 and not word.startswith("-")
    if first and verb == "train":
        yield from installed("fprf.methods")
        return
    if first and verb == "pretrain":
        yield "decoder"
        return
    if first and verb == "doctor":
        yield from installed("fprf.methods")
    if first and verb == "plugins":
        yield "new"
    asked = _asked(verb, words[1:])
    if asked is not None:
        yield from _of_config(asked, words[1:], word)


def _asked(verb: str, rest: Sequence[str]) -> Completing | None:
    """The config that a verb parses its flags with, with the plug-ins that they choose; None without one."""
    # A flag whose value is still to come chooses nothing yet.
    rest = list(rest)
    while rest and rest[-1].startswith("--"):
        rest.pop()
    try:
        if verb in VERBS:
            verb_module(verb).run([*rest, COMPLETING])
        else:
            run_packaged(verb, [*rest, COMPLETING])
    except Completing as asked:
        return asked
    except SystemExit:
        return None
    return None


class _Place(NamedTuple):
    """Position of the cursor in the arguments."""

    flag: str
    """The flag whose values come here; empty where there is none."""
    given: int
    """Values of it that stand there already, or positional words."""


def _place(rest: Sequence[str], flags: dict[str, Flag]) -> _Place:
    """The flag that still takes values at the end of the arguments, or the number of positional words."""
    flag = ""
    given = 0
    positional = 0
    for word in rest:
        if word.startswith("--"):
            flag, equals, _ = word.replace("_", "-").partition("=")
            given = int(bool(equals))
        elif flag and given < (flags[flag].most if flag in flags else 1):
            given += 1
        else:
            flag = ""
            positional += 1
    if flag and given < (flags[flag].most if flag in flags else 1):
        return _Place(flag, given)
    return _Place("", positional)


def _of_config(asked: Completing, rest: Sequence[str], word: str) -> Iterator[str]:
    """Flags of a config, or the values of the flag that is being given."""
    config = asked.config
    flags = {}
    for text, flag in flags_of(config).items():
        if flag.path not in asked.positional:
            flags[text] = flag
    choices = {}
    for slot in slots(config):
        choices[f"--{slot.path.replace('_', '-')}"] = slot.choices
    if word.startswith("-"):
        yield from (*flags, *choices, "--help")
        if isinstance(config, StyleConfig):
            yield from (f"--{name}" for name in PRESETS)
        return
    place = _place(rest, flags)
    if place.flag in choices:
        yield from choices[place.flag]
    elif place.flag in flags:
        yield from _values(flags[place.flag], rest)
    elif not place.flag and place.given < len(asked.positional):
        every = flags_of(config)
        yield from _values(every[f"--{asked.positional[place.given].replace('_', '-')}"], rest)


def _values(flag: Flag, rest: Sequence[str]) -> Iterator[str]:
    """Values of a flag; none where any number, text or file may be given."""
    name = flag.path.rpartition(".")[2]
    for kind in flag.kinds:
        yield from _words_of(kind)
    if name in _RUN_FIELDS:
        yield from _runs()
    if name == "device":
        yield from _DEVICES
    if name in _REGION_FLAGS:
        mark = "=" if name in _REGION_VALUE else ""
        yield from (f"{region}{mark}" for region in _regions(rest))
    if name in _VIEW_FIELDS:
        for run in _named_runs(rest):
            yield from map(str, read_json(run / "scene.json").get("names", ()))


def _words_of(kind: Any) -> Iterator[str]:
    """The words that a type takes, where they can be told."""
    if kind is bool:
        yield from ("true", "false")
    elif get_origin(kind) is Literal:
        yield from map(str, get_args(kind))
    elif isinstance(kind, type) and issubclass(kind, enum.Enum):
        yield from (each.name for each in kind)
    elif get_origin(kind) in (tuple, list):
        yield from _words_of(get_args(kind)[0])


def _runs() -> Iterator[str]:
    """Run folders here, in `runs` and of `fprf demo`."""
    for pattern in ("*/scene.json", "runs/*/scene.json", "*/run/scene.json"):
        for file in sorted(Path().glob(pattern)):
            if (file.parent / "config.json").is_file():
                yield file.parent.as_posix()


def _named_runs(rest: Sequence[str]) -> Iterator[Path]:
    """Run folders that the arguments name."""
    for word in rest:
        if not word.startswith("-") and (as_path(word) / "scene.json").is_file():
            yield as_path(word)


def _regions(rest: Sequence[str]) -> Iterator[str]:
    """Regions of the runs that the arguments name: the names that their styles, and style files among the arguments,
    have given them, and their numbers.
    """
    styles = []
    for word in rest:
        if word.endswith(".json"):
            styles.append(as_path(word))
    for run in _named_runs(rest):
        styles += sorted(run.glob("styles/*/style.json"))
    for style in styles:
        yield from read_json(style).get("regions", {})
    for run in _named_runs(rest):
        with safe_open(run / "style.safetensors", "np") as file:
            name = next((each for each in _KEY_TABLES if each in file.keys()), None)  # noqa: SIM118  # no mapping
            count = 0 if name is None else file.get_slice(name).get_shape()[0]
        yield from map(str, range(count))
