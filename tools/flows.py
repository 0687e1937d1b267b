"""Three pictures of docs/design.md: a training step, a style, and the way from a click to a picture.

    python -m tools.flows                   draws docs/images/flow-*.svg anew

Each box is a function of the package, and stands below the one that hands it its input. `tests/docs/test_flows.py`
runs the three and asks for the same functions in the same order.
"""

import importlib
from collections.abc import Callable
from html import escape
from inspect import getsourcefile, unwrap
from pathlib import Path
from typing import Any, NamedTuple

import fprf

FOLDER = Path(__file__).parents[1] / "docs" / "images"
ROOT = Path(fprf.__file__).parent

BOX_WIDTH = 430
BOX_HEIGHT = 54
GAP = 26
MARGIN = 16
TITLE_HEIGHT = 34
"""Pixels of the drawing; a gap holds the arrow and what it carries."""


class Step(NamedTuple):
    """A function, and what it does."""

    code: str
    """module:name, below fprf; FILE:name of a script of the page."""
    does: str
    gives: str
    """What goes on to the next one, with its shape."""

    @property
    def is_script(self) -> bool:
        """True for a function of the page, which a trace of Python does not show."""
        return self.code.partition(":")[0].endswith(".js")


class Lane(NamedTuple):
    """Steps one below the other."""

    title: str
    steps: tuple[Step, ...]
    alternatives: bool = False
    """True where each stands for itself."""


FLOWS = {
    "training-step": (
        Lane(
            "A step of fields (methods fprf and fprf-lite)",
            (
                Step(
                    "training.driver:learn",
                    "counts steps and time, saves, reports",
                    "step, share of the schedule",
                ),
                Step(
                    "training.field_learner:Batches.__call__",
                    "draws pixels of all photographs",
                    "rgb [R 3], features [R C], [Q D]",
                ),
                Step(
                    "training.field_learner:FieldLearner._rays",
                    "rays in the world, then in the field's space",
                    "origin, direction [R 3]",
                ),
                Step(
                    "rendering.renderer:march",
                    "sampler and density: weights of Eq. 2, the heaviest kept",
                    "weights [R S], M samples",
                ),
                Step(
                    "fields.planes:PlanesField.content",
                    "content features of the kept samples",
                    "content [M C]",
                ),
                Step("rendering.renderer:composite", "sums them along each ray (Eq. 2)", "content [R C]"),
                Step(
                    "rendering.renderer:shade",
                    "the frozen decoder D_VGG, sample by sample; then summed alike",
                    "colours [M 3], rgb [R 3], semantic [Q D]",
                ),
                Step(
                    "training.losses:terms",
                    "Eq. 3 and 4, and the regularisers",
                    "named terms, one number each",
                ),
                Step("training.losses:total", "their weighted sum; then backward and Adam", "new parameters"),
            ),
        ),
        Lane(
            "A step of 3D Gaussians (method fprf-splats)",
            (
                Step(
                    "training.driver:learn",
                    "counts steps and time, saves, reports",
                    "step, share of the schedule",
                ),
                Step("splats.learner:GaussianLearner.step", "chooses the size of the photographs", "level"),
                Step(
                    "splats.learner:GaussianLearner._view",
                    "each photograph once an epoch, sharp ones oftener",
                    "view",
                ),
                Step(
                    "splats.view_corrections:ViewCorrections.moved",
                    "the photograph, its camera where it is now",
                    "H W pixels, axes, centre",
                ),
                Step("splats.learner:GaussianLearner._learning_rates", "by column, falling", "rates [R]"),
                Step(
                    "ops.rasterise.training:TrainableGaussians.learn",
                    "projects, sorts, draws, L1 and SSIM, backward, Adam",
                    "new rows [N R], errors",
                ),
                Step(
                    "splats.view_corrections:ViewCorrections.learn_tones",
                    "exposure and white balance of this photograph",
                    "tones",
                ),
                Step(
                    "splats.view_corrections:ViewCorrections.learn_poses",
                    "where its camera stood, where asked for",
                    "poses",
                ),
                Step(
                    "splats.learner:GaussianLearner._relocate_and_grow",
                    "now and then: Gaussians go to where views err",
                    "N Gaussians",
                ),
            ),
        ),
    ),
    "style": (
        Lane(
            "From photographs to a look",
            (
                Step("style.restyle:apply_style", "reads references, masks, weights", "paths"),
                Step(
                    "style.dictionary:encode_photograph",
                    "both encoders, guided filter, 20 000 pixels",
                    "content [N C], semantic [N D], colour [N 3]",
                ),
                Step(
                    "style.dictionary:build_dictionary",
                    "k-means of the semantics: a code a cluster",
                    "keys [T D], mean [T C], covariance [T C C]",
                ),
                Step(
                    "style.restyle:apply_dictionary",
                    "regions, pins, strengths, light",
                    "allowed [K references]",
                ),
                Step(
                    "plugins.stylizers.region:region_table",
                    "what each region takes: softmax of their match",
                    "keys [K D], [T D]",
                ),
                Step(
                    "style.matching:match_keys",
                    "whitened cosines of regions and codes",
                    "shares [K T]",
                ),
                Step(
                    "style.look:colour_maps",
                    "region-tone: colours of a region to those it takes",
                    "affine maps [K 3 4]",
                ),
            ),
        ),
        Lane(
            "From a look to colours",
            (
                Step(
                    "style.look:Restyle.colour",
                    "fields: stylizer, decoder, colour map at each kept sample",
                    "colours [M 3]",
                ),
                Step(
                    "splats.restyle:restyled_harmonics",
                    "Gaussians: the same map of their spherical harmonics",
                    "harmonics [N B 3]",
                ),
            ),
            alternatives=True,
        ),
    ),
    "click": (
        Lane(
            "From a slider to a picture (fprf view)",
            (
                Step("page/web/live.js:tell", "a message of JSON over the WebSocket", "{type: look, ...}"),
                Step("page.messages:read_message", "checks and decodes it", "a message, typed"),
                Step("page.session:Session.handle", "decides what it asks for", "a change of the state"),
                Step("page.state:SharedState.changed", "a pure function: the new state", "SharedState"),
                Step("page.session:Session._refresh", "what is seen is another", "a job for each client"),
                Step(
                    "page.render_worker:RenderWorker.run",
                    "one thread, newest request first",
                    "steps of a few ms",
                ),
                Step(
                    "page.session:Session._colour", "makes the colours that the route /colours gives", "name"
                ),
                Step(
                    "page.drawing:gaussian_colours",
                    "Gaussians: colours alone are sent",
                    "harmonics, packed",
                ),
                Step("page.drawing:Restyler.styled", "the look, from a cache", "Restyle"),
                Step("page.server:ViewerServer.post", "tells every client", "{type: colours, version}"),
                Step("page/web/splats.js:draw", "sorts and draws with WebGL 2", "a frame"),
            ),
        ),
    ),
}


def function_of(step: Step) -> Callable[..., Any]:
    """The function that a step names. Raises AttributeError, ImportError where there is none."""
    module, _, name = step.code.partition(":")
    found: Any = importlib.import_module(f"fprf.{module}")
    for part in name.split("."):
        found = getattr(found, part)
    function: Callable[..., Any] = unwrap(found)
    return function


def place_of(step: Step) -> str:
    """Its file, below `fprf`."""
    file, _, _ = step.code.partition(":")
    if step.is_script:
        return file
    source = getsourcefile(function_of(step))
    assert source is not None
    return Path(source).relative_to(ROOT).as_posix()


def drawing(lanes: tuple[Lane, ...]) -> str:
    """The flow as SVG: a column a lane, a box a step."""
    longest = max(len(lane.steps) for lane in lanes)
    width = MARGIN + len(lanes) * (BOX_WIDTH + MARGIN)
    height = TITLE_HEIGHT + longest * (BOX_HEIGHT + GAP) + MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" role="img" font-family="system-ui, sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for column, lane in enumerate(lanes):
        left = MARGIN + column * (BOX_WIDTH + MARGIN)
        parts.append(
            f'<text x="{left}" y="22" font-size="14" font-weight="600" fill="#202124">{escape(lane.title)}</text>'
        )
        for row, step in enumerate(lane.steps):
            parts += box(
                step,
                left,
                TITLE_HEIGHT + row * (BOX_HEIGHT + GAP),
                last=lane.alternatives or row == len(lane.steps) - 1,
            )
    return "\n".join([*parts, "</svg>"]) + "\n"


def box(step: Step, left: float, top: float, *, last: bool) -> list[str]:
    """A step, and the arrow to the one below it."""
    name = step.code.partition(":")[2]
    right = left + BOX_WIDTH - 12
    bottom = top + BOX_HEIGHT
    middle = left + 28
    parts = [
        f'<rect x="{left}" y="{top}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="6" fill="#f1f3f4"/>',
        f'<text x="{left + 12}" y="{top + 22}" font-family="ui-monospace, monospace" fill="#1a73e8">{escape(name)}</text>',
        f'<text x="{right}" y="{top + 22}" text-anchor="end" fill="#5f6368" font-size="11">{escape(place_of(step))}</text>',
        f'<text x="{left + 12}" y="{top + 42}" fill="#202124">{escape(step.does)}</text>',
    ]
    if not last:
        parts.append(
            f'<path d="M{middle} {bottom + 2}v{GAP - 6}m-4 -5l4 5l4 -5" stroke="#5f6368" fill="none"/>'
        )
    parts.append(f'<text x="{middle + 12}" y="{bottom + 17}" fill="#5f6368">{escape(step.gives)}</text>')
    return parts


def main() -> None:
    """Write the pictures."""
    for name, lanes in FLOWS.items():
        (FOLDER / f"flow-{name}.svg").write_text(drawing(lanes), "utf-8")


if __name__ == "__main__":
    main()
