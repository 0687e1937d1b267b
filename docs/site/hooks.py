"""What MkDocs is told beyond the files in docs/: the README as the first page, a page for each verb made from its own flags,
and files of the repository that pages link to."""

import contextlib
import importlib
import io
import json
import logging
import os
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from fprf.cli.main import VERBS, Verb
from fprf.cli.parsing import DESCRIBE

ROOT = Path(__file__).resolve().parents[2]
LOG = logging.getLogger("mkdocs.hooks.fprf")
FRONT = {"README.md": "index.md", "CONTRIBUTING.md": "CONTRIBUTING.md"}
"""Pages that lie outside of docs/, and where the site has them."""
LINK = re.compile(r"(?<=\]\()([^)#\s:]+)(#[^)\s]*)?(?=\))")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Verbs, and pages of evidence, join the navigation."""
    nav = config.nav or []
    nav.insert(2, {"Verbs": [{verb: f"verbs/{verb}.md"} for verb in VERBS]})
    evidence = sorted(p.name for p in (ROOT / "docs" / "evidence").glob("*.md") if p.name != "README.md")
    next(iter(nav[-1].values())).extend(f"evidence/{name}" for name in evidence)
    listed = set(_pages(nav))
    rest = sorted(p.name for p in (ROOT / "docs").glob("*.md") if p.name not in listed)
    if rest:
        nav.append({"More": rest})
    config.nav = nav
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds what does not lie in docs/."""
    for source, page in FRONT.items():
        files.append(File.generated(config, page, content=moved((ROOT / source).read_text("utf-8"), source, page)))
    for verb, about in VERBS.items():
        files.append(File.generated(config, f"verbs/{verb}.md", content=verb_page(verb, about)))
    wanted = {path for file in list(files) if file.is_documentation_page() for path in linked(file)}
    for path in sorted(wanted - {file.src_uri for file in files}):
        source = ROOT / path.removeprefix("repository/")
        if source.is_file():
            files.append(File.generated(config, path, abs_src_path=str(source)))
        else:
            LOG.warning("a page links to %s, which is no file of the repository", source.relative_to(ROOT))
    return files


def on_page_markdown(markdown: str, page: Any, config: MkDocsConfig, files: Files) -> str:
    """Links from docs/ to the rest of the repository lead to its copies on the site."""
    uri = page.file.src_uri
    return markdown if uri in FRONT.values() or uri.startswith("verbs/") else moved(markdown, f"docs/{uri}", uri)


def linked(file: File) -> set[str]:
    """Files of the repository, by their place on the site, that a page leads to."""
    uri = file.src_uri
    text = file.content_string if file.generated_by else moved((ROOT / "docs" / uri).read_text("utf-8"), f"docs/{uri}", uri)
    targets = {posixpath.normpath(posixpath.join(posixpath.dirname(uri), m[1])) for m in LINK.finditer(text)}
    return {target for target in targets if target.startswith("repository/")}


def moved(markdown: str, source: str, page: str) -> str:
    """A text whose links are relative to `source` in the repository, as one that is `page` on the site."""

    def turn(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[1]))
        if (ROOT / target).is_dir():
            target = posixpath.join(target, "README.md")
        place = FRONT.get(target) or (target[5:] if target.startswith("docs/") else f"repository/{target}")
        return posixpath.relpath(place, posixpath.dirname(page) or ".") + (match[2] or "")

    parts = re.split(r"(^```.*?^```)", markdown, flags=re.S | re.M)
    return "".join(part if part.startswith("```") else LINK.sub(turn, part) for part in parts)


def verb_page(verb: str, about: Verb) -> str:
    """One page: what the verb is for, and every flag with what it takes, its default and its meaning."""
    lines = [
        f"# fprf {verb}",
        "",
        f"{about.summary[0].upper()}{about.summary[1:]}.",
        "",
        "```text",
        f"fprf {verb} {about.usage}",
        "```",
    ]
    words: tuple[str | None, ...] = {"pretrain": ("decoder",), "train": ("fprf-lite",)}.get(verb, (None,))
    for word in words:
        found = described(verb, word)
        if found is None:
            lines += ["", "```text", help_of(verb), "```"]
            continue
        title = [] if word is None or verb == "train" else ["", f"## {verb} {word}"]
        lines += [*title, "", found["description"].strip(), *tables(found)]
    if verb == "train":
        lines += ["", "Defaults are those of `fprf-lite`. Fields of other plug-ins follow from what fills a slot:", ""]
        lines += ["`fprf train METHOD --semantic.encoder vgg19 --help` shows them."]
    return "\n".join([*lines, ""])


def described(verb: str, word: str | None) -> dict[str, Any] | None:
    """What the verb says of itself; None if it has no flags."""
    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.suppress(SystemExit, Exception):
        importlib.import_module(f"fprf.cli.{verb}").run([*([word] if word else []), DESCRIBE])
    return json.loads(heard.getvalue()) if heard.getvalue().startswith("{") else None


def help_of(verb: str) -> str:
    """What `--help` prints."""
    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.suppress(SystemExit):
        importlib.import_module(f"fprf.cli.{verb}").run(["--help"])
    return heard.getvalue().strip()


def tables(found: dict[str, Any]) -> list[str]:
    """Flags in one table for each config that they belong to, and the slots."""
    lines: list[str] = []
    for owner in dict.fromkeys(row["of"] for row in found["flags"]):
        lines += ["", f"### {owner}"] if owner else []
        lines += ["", "| flag | meaning |", "|---|---|"]
        for row in (row for row in found["flags"] if row["of"] == owner):
            name = row["flag"].upper() if row["positional"] else row["flag"]
            default = f"; `{row['default']}`" if row["default"] else ""
            takes = "required" if row["positional"] else f"{row['takes']}{default}"
            # The meaning first: on a phone little more is seen.
            lines.append(f"| `{name}` | {cell(row['meaning'])}<br>*{cell(takes)}* |")
    if found["slots"]:
        lines += ["", "### Plug-ins", "", "| slot | what fills it |", "|---|---|"]
        for slot in found["slots"]:
            names = ", ".join(slot["one of"])
            lines.append(f"| `{slot['flag']}` | {cell(slot['meaning'])}<br>*one of {names}*; `{slot['default']}` |")
    return lines


def cell(text: str) -> str:
    """A text that a table can hold."""
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def _pages(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [page for part in (nav.values() if isinstance(nav, dict) else nav) for page in _pages(part)]


os.environ.setdefault("NO_COLOR", "1")
