"""The page of a run's report: charts and figures in the gallery's look, one file that loads nothing."""

from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from .atomic import write_text
from .figures import number

__all__ = ["write_report"]


def write_report(
    path: Path,
    *,
    title: str,
    facts: Mapping[str, str | int | float],
    charts: Sequence[str],
    parts: str,
    notes: Sequence[str],
) -> None:
    """Write the page, whole or not at all. `charts` and `parts` are HTML of `io.chart`; all else is shown as text."""
    shown = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(number(fact))}</dd></div>" for name, fact in facts.items())
    sections = [f'<section class="opening"><h1>{escape(title)}</h1><dl class="facts">{shown}</dl></section>']
    if charts:
        sections.append(f'<section><h2>Training</h2><div class="charts">{"".join(charts)}</div></section>')
    if parts:
        sections.append(f"<section><h2>Where the time went</h2>{parts}</section>")
    if notes:
        listed = "".join(f"<li>{escape(note)}</li>" for note in notes)
        sections.append(f'<section><h2>What happened on the way</h2><ul class="notes">{listed}</ul></section>')
    here = files(__package__)
    css = (here / "gallery.css").read_text("utf-8") + (here / "report.css").read_text("utf-8")
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    write_text(
        path,
        f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>
{css}</style>
</head>
<body>
<header class="bar"><span class="mark" aria-hidden="true">fprf</span></header>
<main>
{"".join(sections)}
</main>
<footer><p>Made with fprf. This page is one file: it loads nothing and can be sent as it is.</p></footer>
</body>
</html>
""",
    )
