"""The same page, served: what `fprf view` sends of it. Imports nothing heavy, since the page does not wait for the scene."""

from importlib.resources import files
from string import Template

SCRIPTS = ("splats.js", "place.js", "page.js")


def read(name: str) -> str:
    """A text of this package."""
    return (files(__package__) / name).read_text("utf-8")


def script(*more: str) -> str:
    """The page's scripts, one after the other."""
    return "\n".join(read(name) for name in (*SCRIPTS, *more))


def live_page() -> str:
    """The page of `fprf view`."""
    stage = Template(read("stage.html")).substitute(still="hidden", ratio="", facts=read("panel.html"))
    return Template(read("live.html")).substitute(stage=stage)


def live_script() -> str:
    """Its scripts."""
    return script("live.js", "start.js") + "\nlive();\n"


def live_style() -> str:
    """Its style sheets."""
    return read("page.css") + read("live.css")
