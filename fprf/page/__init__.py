"""The page that shows a scene in 3D: one file (`fprf restyle --page`), or served with a scene behind it
(`fprf view`).

- What browsers run: `web/`, typed by JSDoc (`tsc -p tsconfig.json`). Every page has `stage.html`, `page.css`,
  `sun.css`
  and `_SCRIPTS`: `shaders.js`, `graphics.js`, `packed.js` and `splats.js` draw, `camera.js`, `steering.js` and
  `place.js` move, `stage.js` has the controls, `send.js` links, `headset.js` headsets, `sun.js` the light.
  `page.html` and `page.js` are the file that one sends; `live.html`, `live.css`, `panel.html` and the scripts that `server.py`
  names are the served page.
- Gaussians as bytes: `pack.py`. The page as one file: `writer.py`.
- Who may connect, and with what: `server.py`, `messages.py`. Photographs and files that come: `uploads.py`,
  `start.py`.
- What is shown, as values: `state.py`; what of it is kept in the scene's folder: `saved.py`. The scene that
  is open, its photographs and its training: `session.py`.
- Its styles, and what they show, drawn step by step: `drawing.py`, in the thread of `render_worker.py`.
"""

import base64
from importlib.resources import files
from pathlib import Path

GARDEN = Path(str(files("fprf") / "garden"))
"""Photographs of a place that ship with fprf."""
EXAMPLES = {path.name: path for path in sorted((GARDEN / "references").glob("*.jpg"))}
"""Photographs to restyle a scene with that ship with fprf, by name."""

_SCRIPTS = (
    "shaders.js",
    "dom.js",
    "graphics.js",
    "packed.js",
    "splats.js",
    "camera.js",
    "steering.js",
    "place.js",
    "headset.js",
    "send.js",
    "sun.js",
    "stage.js",
)
"""Scripts of every page, in the order in which they run."""
PAGE_SCRIPTS = ("page.js",)
"""Scripts of the file that one sends, besides."""


def read_asset(name: str) -> str:
    """A text that browsers get: a file of `web/`."""
    return (files(__package__) / "web" / name).read_text("utf-8")


def css(*more: str) -> str:
    """The styles of every page with their typeface, and `more`, one after the other."""
    font = base64.b64encode((files(__package__) / "web" / "fonts" / "figtree.woff2").read_bytes()).decode()
    face = f'@font-face {{ font-family: Figtree; font-weight: 300 900; src: url("data:font/woff2;base64,{font}"); }}'
    return "\n".join([face, *map(read_asset, ("page.css", "sun.css", *more))])


def script(*more: str) -> str:
    """The scripts of every page, and `more`, one after the other."""
    return "\n".join(map(read_asset, (*_SCRIPTS, *more)))
