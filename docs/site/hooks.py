"""Additions to the files in docs/ for MkDocs: the README as the first page, a page for each verb made from
its own flags, and files of the repository that pages link to.
"""

import contextlib
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

from fprf.cli.config_schema import schema
from fprf.cli.main import VERBS, Verb, verb_module

ROOT = Path(__file__).resolve().parents[2]
LOG = logging.getLogger("mkdocs.hooks.fprf")
FRONT = {"README.md": "index.md", "CONTRIBUTING.md": "CONTRIBUTING.md"}
"""Pages that lie outside of docs/, and where the site has them."""
FRAME = (
    '<iframe src="garden.html" title="A garden to walk through, in four lights" loading="lazy" '
    'sandbox="allow-scripts" style="width: 100%; height: 32rem; border: 0"></iframe>'
)
PICTURES = {
    "process": ("images/verbs/process.svg", "What it says of 26 photographs of a garden"),
    "train": (
        "images/verbs/train.webp",
        "Two photographs that training did not see, and beside each the scene",
    ),
    "eval": ("images/verbs/eval.svg", "The garden of the demo, measured"),
    "stylize": (
        "images/verbs/stylize.webp",
        "A photograph, the reference, the view in its style, and the match",
    ),
    "restyle": ("images/gaussians.jpg", '"Houseplant" by Marcel Padilla, CC BY 4.0; colours changed by fprf'),
    "gallery": ("images/garden.jpg", "Views that training did not see, as trained and in four styles"),
    "render": ("images/verbs/render.webp", "Four frames of a spiral, at night"),
    "view": ("images/viewer-compare.jpg", "The garden as captured left of the line, in a style right of it"),
    "export": (
        "images/export-town.jpg",
        "A town as drawn here, and from files that it writes, plain and in a style",
    ),
    "pretrain": ("images/verbs/pretrain.svg", "What it says of twelve photographs and 200 steps"),
    "plugins": ("images/verbs/plugins.svg", "The first of what is installed"),
    "config-schema": ("images/verbs/config-schema.svg", "The schema of a style begins so"),
    "doctor": ("images/verbs/doctor.svg", "What it says of a folder of photographs with poses"),
}
"""A picture of each verb, made by it, with what it shows; `demo` has the garden itself."""
LIVE = re.compile(r"^!\[[^\]]*\]\([^)]*garden\.webp\)$", re.MULTILINE)
"""The README's film, in the place of which the first page has the garden itself."""
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
    """Adds what does not lie in docs/: pages, schemas of files."""
    for source, page in FRONT.items():
        content = moved((ROOT / source).read_text("utf-8"), source, page)
        if page == "index.md":
            content = LIVE.sub(FRAME, content)
        files.append(File.generated(config, page, content=content))
    for verb, about in VERBS.items():
        files.append(File.generated(config, f"verbs/{verb}.md", content=verb_page(verb, about)))
    for name in ("style", "keyframes", "config"):
        text = json.dumps(schema(name), indent=1)
        files.append(File.generated(config, f"schemas/{name}.schema.json", content=text))
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
    if uri in FRONT.values() or uri.startswith("verbs/"):
        return markdown
    # A page of the repository that others link to has links of its own.
    source = uri.removeprefix("repository/") if uri.startswith("repository/") else f"docs/{uri}"
    return moved(markdown, source, uri)


def linked(file: File) -> set[str]:
    """Files of the repository, by their place on the site, that a page leads to."""
    uri = file.src_uri
    text = (
        file.content_string
        if file.generated_by
        else moved((ROOT / "docs" / uri).read_text("utf-8"), f"docs/{uri}", uri)
    )
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
        "",
    ]
    if verb in PICTURES:
        picture, shown = PICTURES[verb]
        lines += [f"![{shown}](../{picture})", "", f"*{shown}*"]
    else:
        lines.append(FRAME.replace('src="', 'src="../'))
    word = {"pretrain": ["decoder"], "train": ["fprf-lite"]}.get(verb, [])
    lines += ["", "```text", help_of(verb, word), "```"]
    if verb == "train":
        lines += [
            "",
            "Defaults are those of `fprf-lite`. Fields of other plug-ins follow from what fills a slot:",
            "",
        ]
        lines += ["`fprf train METHOD --semantic.encoder vgg19 --help` shows them."]
    return "\n".join([*lines, ""])


def help_of(verb: str, words: list[str]) -> str:
    """Text that `--help` prints."""
    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.suppress(SystemExit):
        verb_module(verb).run([*words, "--help"])
    return heard.getvalue().strip()


def _pages(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [page for part in (nav.values() if isinstance(nav, dict) else nav) for page in _pages(part)]


os.environ.setdefault("NO_COLOR", "1")
