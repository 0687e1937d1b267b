"""Origins of figures, and a check of those that pages quote.

Each result, `benchmarks/results/NAME.json` or `docs/evidence/NAME.json`, has an `origin`: the commit that was measured, the
command, the date, the sources (paths of the repository) that the figures depend on, and a hash of these sources. Once
they have changed, the result is measured again, or `before` says what has changed; pages then repeat it.

In a page a measured figure stands in a paragraph (or item of a list) with `<!-- of: NAME -->...<!-- end -->`, whose text
`python -m benchmarks tables` writes, and has to be found in NAME.json; NAME/KEY/KEY looks in that part of it alone. A
table belongs to the paragraph above it. Paragraphs whose numbers are no measurements of ours say so:
`<!-- unmeasured: WHY -->`.
"""

import ast
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from fprf.errors import DataError

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = (Path("benchmarks/results"), Path("docs/evidence"))
ORIGIN = "origin"
"""Key of a result that holds where it comes from."""
DERIVED = "derived"
"""Key of a result that holds differences and ratios of its figures which pages quote, by what they are: `A - B`, `A : B`."""
HASH_DIGITS = 16


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Origin of a result."""

    commit: str
    """Short hash; `+` behind it: with changes that were not committed."""
    command: str
    """Command that measured it, from the root of the repository; in words where it took several."""
    date: str
    """Day, YYYY-MM-DD."""
    sources: tuple[str, ...]
    """Files and folders of the repository that the figures depend on."""
    sources_hash: str
    """Of these at that commit (`sources_hash`)."""
    before: str = ""
    """Changes in the sources since; empty: none."""

    @property
    def mark(self) -> str:
        """Note beside figures of older sources on pages; else empty."""
        return f"of {self.commit}, before {self.before}" if self.before else ""


def result_files(root: Path = ROOT) -> dict[str, Path]:
    """All results by name, without the ending."""
    return {path.stem: path for folder in FOLDERS for path in sorted((root / folder).glob("*.json"))}


def read_result(path: Path) -> tuple[Origin, dict[str, Any]]:
    """Origin and figures of a result. Raises DataError where the origin is missing or incomplete."""
    found = json.loads(path.read_text("utf-8"))
    try:
        told = dict(found.pop(ORIGIN))
        origin = Origin(**{**told, "sources": tuple(told["sources"])})
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path.name}: no complete origin ({error}); make it by `python -m benchmarks record`"
        ) from None
    return origin, found


def document(origin: Origin, figures: dict[str, Any]) -> dict[str, Any]:
    """Content of a result's file."""
    told = {key: value for key, value in asdict(origin).items() if value != ""}
    return {ORIGIN: told, **figures}


def sources_hash(sources: Iterable[str], root: Path = ROOT) -> str:
    """A hash of files and folders that comments, docstrings and layout of Python do not change. What is not there
    counts as empty.
    """
    total = hashlib.sha256()
    for source in sorted(sources):
        for path in _files(root / source):
            total.update(f"{path.relative_to(root).as_posix()}\n{_file_hash(path)}\n".encode())
    return total.hexdigest()[:HASH_DIGITS]


def stale(origin: Origin, root: Path = ROOT) -> bool:
    """True where sources have changed since, and nothing says what."""
    return not origin.before and sources_hash(origin.sources, root) != origin.sources_hash


def _files(place: Path) -> list[Path]:
    if place.is_file():
        return [place]
    return [path for path in sorted(place.rglob("*")) if path.is_file() and "__pycache__" not in path.parts]


@cache
def _file_hash(path: Path) -> str:
    data = path.read_bytes()
    if path.suffix == ".py":
        data = "".join(_code(ast.parse(data))).encode()
    return hashlib.sha256(data).hexdigest()


def _code(node: Any) -> Iterator[str]:
    """A syntax tree as text, without positions and without texts that stand alone. What is empty is left out, so
    that versions of Python with further fields give the same.
    """
    if isinstance(node, list):
        for each in node:
            yield from _code(each)
        return
    if not isinstance(node, ast.AST):
        yield repr(node)
        return
    if (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    ):
        return
    yield f"{type(node).__name__}("
    for name, value in ast.iter_fields(node):
        if value is not None and value != []:
            yield f"{name}="
            yield from _code(value)
    yield ")"


OF = re.compile(r"<!-- of: (\S+) -->(.*?)<!-- end -->", re.DOTALL)
TABLE = re.compile(r"<!-- table: [\w ]+ -->\n.*?<!-- end -->", re.DOTALL)
UNMEASURED = re.compile(r"<!-- unmeasured: [^>]+ -->")
_CODE_BLOCK = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
_CODE = re.compile(r"`[^`\n]*`")
_LINK_TARGET = re.compile(r"\]\([^)\s]*\)")
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_NUMBER = r"[−-]?\d+(?: \d{3})*(?:\.\d+)?"
_UNITS = r"dB|ms|s|seconds?|min|minutes?|h|hours?|MiB|GiB|GB|MB|%|times|×|rays/s"
_FIGURE = re.compile(
    rf"(?<![\w.,/:])(?P<list>(?:{_NUMBER}(?:,| to| and| or| /|, and) )*{_NUMBER})(?P<gap> ?)(?P<unit>{_UNITS})(?![\w/])"
    rf"|(?<![\w.,/:=])(?P<bare>\d+\.\d\d+)(?![\w.%])"
)
_SCALES = {
    "s": (1.0, 1e-3),
    "ms": (1.0, 1e3),
    "min": (1.0, 1 / 60),
    "h": (1.0, 1 / 3600),
    "%": (1.0, 100.0),
    "MiB": (1.0, 2.0**-20),
    "GiB": (1.0, 2.0**-10, 2.0**-30),
    "GB": (1.0, 1e-3, 2.0**-10, 1e-9),
    "MB": (1.0, 1e-6),
}
"""Factors from a value of a result to the figure in that unit."""
_TIME = r"second|minute|time|(^|/|_)(ms|s|min)(/|$)"
_KEYS = {
    "dB": r"psnr|db(/|$)",
    "ms": _TIME,
    "s": _TIME,
    "min": _TIME,
    "h": _TIME,
    "MiB": r"mib|bytes",
    "GiB": r"mib|gib|gb|bytes|rss",
    "GB": r"mib|gib|gb|bytes|rss",
    "MB": r"mb|bytes",
    "rays/s": r"rays|per_second",
}
"""Of values in that unit, what one of their keys may hold."""
_OTHER_KEYS = "|".join({*_KEYS.values(), "ssim|lpips|delta_e|share|steps|gaussians(/|$)"})
"""Of values that have some other unit, or none; keys that say nothing of units rule nothing out."""
_ROUNDING = 0.51
"""Of the last digit that is printed: a half, and what a value that was itself rounded adds."""


@dataclass(frozen=True)
class Figure:
    """A number with a unit, or with two decimals at least, as a page prints it."""

    text: str
    unit: str

    def equals(self, value: "Value") -> bool:
        """True where a result's value, rounded, is this figure; signs do not count. Keys of another unit rule
        it out.
        """
        keys = value.keys.lower()
        if self.unit in _KEYS and not re.search(_KEYS[self.unit], keys) and re.search(_OTHER_KEYS, keys):
            return False
        digits = self.text.replace(" ", "").lstrip("−-")
        last = 10.0 ** -len(digits.partition(".")[2])
        if " " in self.text:
            last = 10.0 ** (len(digits) - len(digits.rstrip("0")))
        return any(
            abs(abs(value.number) * scale - float(digits)) <= _ROUNDING * last
            for scale in _SCALES.get(self.unit, (1.0,))
        )


def blocks(page: str) -> Iterator[str]:
    """Paragraphs, items of lists and rows of tables of a page, without blocks of code and generated tables."""
    for block in re.split(r"\n\s*\n|\n(?=\||\s*[*-] |\s*\d+\. )", TABLE.sub("", _CODE_BLOCK.sub("", page))):
        if block.strip():
            yield block


def figures(block: str) -> Iterator[Figure]:
    """Figures of a paragraph that could be measurements; words of code, comments and addresses are none."""
    plain = _LINK_TARGET.sub("]", _CODE.sub("`", _COMMENT.sub("", OF.sub("", block)))).replace("*", "")
    for found in _FIGURE.finditer(plain):
        if found["bare"]:
            yield Figure(found["bare"], "")
            continue
        unit = re.sub(
            r"(second|minute|hour)s?",
            lambda word: word[1][0] if word[1] != "minute" else "min",
            found["unit"],
        )
        for number in re.findall(_NUMBER, found["list"]):
            yield Figure(number, unit)


class Value(NamedTuple):
    """A number of a result."""

    number: float
    keys: str
    """Under which it stands, as KEY/KEY; empty within a text."""


def values(found: Any, keys: str = "") -> Iterator[Value]:
    """All numbers of a part of a result, also those within texts."""
    if isinstance(found, dict):
        unit = found.get("unit")
        for name, each in found.items():
            told = unit if unit and name in ("figure", "low", "high", "peer", "measured", "bound") else name
            yield from values(each, f"{keys}/{told}")
    elif isinstance(found, list):
        for each in found:
            yield from values(each, keys)
    elif isinstance(found, str):
        yield from (Value(float(number), "") for number in re.findall(r"\d+\.?\d*", found))
    elif isinstance(found, int | float) and not isinstance(found, bool):
        yield Value(found, keys)


def quoted(name: str, root: Path = ROOT) -> list[Value]:
    """Numbers that a paragraph with `<!-- of: NAME/KEY/... -->` may quote: those of that part, and without a key also what
    `derived` computes and the numbers of the command. Raises DataError for what is not there.
    """
    stem, *keys = name.split("/")
    path = result_files(root).get(stem)
    if path is None:
        raise DataError(f"{name}: no such result in {' or '.join(map(str, FOLDERS))}")
    origin, found = read_result(path)
    if keys:
        return list(values(part(found, keys, path), "/".join(keys)))
    computed = [Value(derived(text, found, path), "") for text in found.pop(DERIVED, {}).values()]
    return [*values(found), *values(origin.command), *computed]


def part(found: Any, keys: list[str], path: Path) -> Any:
    """Entry of a result under keys, one after the other; of a list by position. `_` also finds a blank."""
    for key in keys:
        try:
            if isinstance(found, list):
                found = found[int(key)]
            else:
                found = found[key if key in found else key.replace("_", " ")]
        except (KeyError, IndexError, ValueError, TypeError):
            raise DataError(f"{path.name}: no {key} in {'/'.join(keys)}") from None
    return found


def derived(text: str, found: Any, path: Path) -> float:
    """A difference or ratio of two numbers of a result, `KEY/KEY - KEY/KEY` or `KEY/KEY : KEY/KEY`."""
    first, sign, second = re.split(r" ([-:]) ", text)
    left = float(part(found, first.split("/"), path))
    right = float(part(found, second.split("/"), path))
    return left - right if sign == "-" else left / right


def unfounded(page: str, root: Path = ROOT) -> list[str]:
    """A line for each figure of a page that stands in no result that its paragraph names."""
    wrong = []
    above: list[str] = []
    for block in blocks(page):
        names = [place[1] for place in OF.finditer(block)]
        if block.lstrip().startswith("|"):
            names += above
        else:
            above = names
        if UNMEASURED.search(block):
            continue
        known = [value for name in names for value in quoted(name, root)]
        for figure in figures(block):
            if not any(map(figure.equals, known)):
                where = f"not in {', '.join(names)}" if names else "its paragraph names no result"
                wrong.append(
                    f"{figure.text} {figure.unit}".strip() + f": {where}: {' '.join(block.split())[:90]}"
                )
    return wrong


def link(name: str, page: Path, root: Path = ROOT) -> str:
    """Text between the marks of a quoted result: a link to it, and what it is older than."""
    path = result_files(root)[name.split("/")[0]]
    origin, _ = read_result(path)
    target = Path(os.path.relpath(path, page.parent)).as_posix()
    return ", ".join(part for part in (f"[`{path.name}`]({target})", origin.mark) if part)


def pages(root: Path = ROOT) -> list[Path]:
    """Pages whose figures are checked: all but those that a benchmark has written whole beside its JSON."""
    written = {path.with_suffix(".md") for path in result_files(root).values()}
    found = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    return [path for path in found if path not in written]


def uncited(root: Path = ROOT) -> list[str]:
    """Results that no page, and no comment of the package, names."""
    known = result_files(root)
    texts = [path.read_text("utf-8") for path in (*pages(root), *sorted((root / "fprf").rglob("*.py")))]
    everything = "\n".join(texts)
    return [
        name
        for name in known
        if not re.search(rf"(table: {name} |of:? {name}[/ ]|\b{re.escape(name)}\.(json|md)\b)", everything)
    ]
