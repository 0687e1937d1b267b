"""`fprf stylize RUN --references A.jpg B.jpg`: captured views in the style of photographs."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..checks import at_least, between
from ..plugins.stylizers.config import RegionOtConfig, StylizerConfig
from .parsing import parse
from .progress import Display

if TYPE_CHECKING:
    from ..engine.loading import Trained
    from ..engine.restyle import Styled

__all__ = ["StyleConfig", "StylizeConfig", "build_style", "run"]

_LONGEST = 80
"""Characters of a style's default name."""


@dataclass(frozen=True, kw_only=True)
class StyleConfig:
    """How references become a style."""

    stylizer: StylizerConfig = RegionOtConfig()
    """What moves the scene's features."""
    strength: float = 1.0
    """0 leaves the scene bit for bit as it is, 1 is the full style."""
    weights: tuple[float, ...] = ()
    """How much each reference counts, in their order; none = all alike."""
    clusters: int = 10
    """Local styles per reference."""
    blend: float = 0.3
    """Share of a reference's overall style in each of its local ones."""

    def __post_init__(self) -> None:
        between("strength", self.strength, 0.0, 1.0)
        between("blend", self.blend, 0.0, 1.0)
        at_least("clusters", self.clusters, 1)
        for weight in self.weights:
            at_least("weights", weight, 1e-6)


@dataclass(frozen=True, kw_only=True)
class StylizeConfig(StyleConfig):
    """Which views to restyle, and with what."""

    run: Path = Path()
    """Run folder."""
    references: tuple[Path, ...] = ()
    """Photographs whose style the scene takes."""
    output: Path | None = None
    """Folder for the pictures; by default RUN/styles/NAMES-OF-THE-REFERENCES."""
    split: Literal["test", "train", "all"] = "test"
    """Views to restyle."""
    matches: bool = True
    """Also write which reference each pixel takes, as NAME-match.png."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""


def build_style(trained: "Trained", references: tuple[Path, ...], config: StyleConfig) -> "Styled":
    """The style of a config on a run."""
    from ..engine.restyle import restyle

    return restyle(
        trained,
        references,
        config.stylizer,
        strength=config.strength,
        weights=config.weights,
        clusters=config.clusters,
        blend=config.blend,
    )


def run(args: list[str]) -> int:
    """Build the style, render the views, write pictures, match maps, dictionary and style.json."""
    description = "Restyle captured views with photographs; no training, the same look from every viewpoint."
    config = parse(StylizeConfig(), args, prog="fprf stylize", description=description, positional=("run",))
    from ..engine.loading import load_run
    from ..engine.views import match_view, render_view
    from ..output.atomic import write_json
    from ..output.images import to_uint8, write_image
    from ..output.maps import match_image, match_summary
    from ..style.dictionary import save_dictionary

    trained = load_run(config.run, config.device)
    start = time.perf_counter()
    styled = build_style(trained, config.references, config)
    dictionary_seconds = time.perf_counter() - start
    output = config.output or config.run / "styles" / _name(config.references)
    views, known, render = trained.known.split(config.split), trained.known, trained.config.render
    summaries, seconds = {}, 0.0
    with Display() as display:
        for i, view in enumerate(views):
            display.count(i, len(views), "restyling")
            start = time.perf_counter()
            picture = render_view(trained.model, known.facts, known.cameras, view, render, styled.restyle)
            seconds += time.perf_counter() - start
            write_image(output / f"{known.names[view]}.png", to_uint8(picture.rgb))
            if config.matches:
                attention = match_view(trained.model, known.cameras, view, render, styled.restyle.stylizer)
                of, names = styled.dictionary.reference, styled.dictionary.names
                write_image(output / f"{known.names[view]}-match.png", match_image(attention, of, names, picture.opacity))
                summaries[known.names[view]] = match_summary(attention, of, names, picture.opacity)
        display.count(len(views), len(views), "restyling")
    save_dictionary(output / "dictionary.safetensors", styled.dictionary)
    write_json(
        output / "style.json",
        {
            "references": [p.name for p in config.references],
            "strength": config.strength,
            "dictionary_seconds": dictionary_seconds,
            "seconds_per_view": seconds / max(1, len(views)),
            "codes": len(styled.dictionary.keys),
            "matches": summaries,
        },
    )
    print(f"{len(views)} views in {output}  (style {dictionary_seconds:.2f} s, {seconds / max(1, len(views)):.2f} s a view)")
    return 0


def _name(references: tuple[Path, ...]) -> str:
    """The stems joined, cut to what every file system takes."""
    joined = "+".join(p.stem for p in references)
    return joined if len(joined) <= _LONGEST else f"{joined[:_LONGEST]}+{len(references)}"
