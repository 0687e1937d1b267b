"""`fprf completion bash|zsh|fish`: a script by which a shell completes verbs, their words, flags and files.

tyro (shtab) and argcomplete complete one parser; here each verb has its own and, of `train`, each method. So every verb is
asked for its flags once, when the script is made, and pressing the key starts no program, which would take 0.1 s and more.
"""

import contextlib
import io
from collections.abc import Callable, Mapping
from typing import NamedTuple

from ..errors import FprfError, UsageError
from ..export.config import KINDS
from ..plugins.registry import installed
from .bench import NAMES
from .main import VERBS, packaged, run_verb
from .parsing import LIST_FLAGS

_USAGE = """usage: fprf completion bash|zsh|fish

Prints a script that lets the shell complete verbs, flags and files:
  bash    fprf completion bash > ~/.local/share/bash-completion/completions/fprf
  zsh     fprf completion zsh > ~/.fprf.zsh && echo 'source ~/.fprf.zsh' >> ~/.zshrc
  fish    fprf completion fish > ~/.config/fish/completions/fprf.fish
Make it again after installing a plug-in."""

_WORDS = {
    "pretrain": ("decoder",),
    "bench": tuple(NAMES),
    "export": tuple(KINDS),
    "completion": ("bash", "zsh", "fish"),
}
"""Words of verbs that have a few."""
_FIRST = ("pretrain", "bench")
"""Verbs whose flags depend on the word."""


class Offer(NamedTuple):
    """Words and flags that can follow a verb."""

    summary: str
    words: tuple[str, ...]
    flags: tuple[str, ...]


def run(args: list[str]) -> int:
    """Print the script."""
    if args in (["-h"], ["--help"]):
        print(_USAGE)
        return 0
    if len(args) != 1 or args[0] not in SHELLS:
        raise UsageError(f"fprf completion {' '.join(args)}: name one shell: {', '.join(SHELLS)}")
    print(SHELLS[args[0]](offers()), end="")
    return 0


def offers() -> dict[str, Offer]:
    """Every verb with its words and flags; a verb that cannot say goes without flags."""
    described = {}
    summaries = {verb: about.summary for verb, about in VERBS.items()}
    for verb, summary in (summaries | {verb: f"of {package}" for verb, package in packaged().items()}).items():
        words = tuple(installed("fprf.methods")) if verb == "train" else _WORDS.get(verb, ())
        heard = io.StringIO()
        for args in [[word] for word in words] if verb in (*_FIRST, "train") else [[]]:
            with contextlib.redirect_stdout(heard), contextlib.suppress(SystemExit, FprfError):
                run_verb(verb, [*args, LIST_FLAGS])
        flags = {line for line in heard.getvalue().splitlines() if line.startswith("--")}
        described[verb] = Offer(summary, words, tuple(sorted({*flags, "--help"})))
    return described


def _bash(known: Mapping[str, Offer]) -> str:
    cases = "\n".join(
        f'    {verb}) words="{" ".join(offer.words)}" flags="{" ".join(offer.flags)}" ;;' for verb, offer in known.items()
    )
    return f"""# made by `fprf completion bash`
_fprf() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}" verb="${{COMP_WORDS[1]}}" words="" flags=""
  COMPREPLY=()
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "{" ".join(known)} --help --version" -- "$word"))
    return
  fi
  case "$verb" in
{cases}
  esac
  case "$word" in
    -*) COMPREPLY=($(compgen -W "$flags" -- "$word")) ;;
    *)
      if [ "$COMP_CWORD" -eq 2 ]; then COMPREPLY=($(compgen -W "$words" -- "$word")); fi
      COMPREPLY+=($(compgen -f -- "$word"))
      ;;
  esac
}}
complete -o filenames -o bashdefault -F _fprf fprf
"""


def _zsh(known: Mapping[str, Offer]) -> str:
    start = "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n"
    return start + _bash(known)


def _fish(known: Mapping[str, Offer]) -> str:
    lines = ["# made by `fprf completion fish`"]
    for verb, offer in known.items():
        lines.append(f"complete -c fprf -n __fish_use_subcommand -f -a {verb} -d {_quoted(offer.summary)}")
        here = f"-n {_quoted(f'__fish_seen_subcommand_from {verb}')}"
        if offer.words:
            lines.append(f"complete -c fprf {here} -a {_quoted(' '.join(offer.words))}")
        lines += [f"complete -c fprf {here} -l {flag.removeprefix('--')}" for flag in offer.flags]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


SHELLS: dict[str, Callable[[Mapping[str, Offer]], str]] = {"bash": _bash, "zsh": _zsh, "fish": _fish}
"""Writers of scripts by the name of the shell."""
