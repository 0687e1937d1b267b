"""`fprf stylize RUN --references A.jpg B.jpg`: captured views in the style of photographs."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..io.overwriting import Origin, unused_name
from ..progress import Display
from ..style.files import style_key, write_style
from .style_flags import StyledRunConfig, origin_of, read_flags, style_name

if TYPE_CHECKING:
    from ..scenes import Scene
    from ..style.regions import Regions
    from ..style.restyle import Styled

_MIN_TABLE_SHARE = 0.1
"""References that a region takes less of are not in the table: by eye, three fit on a line."""

_HEAD: tuple[str, ...] = ("region", "share", "seen best at", "strength", "sure", "entropy", "takes")

_STYLIZE_HELP = """Restyle captured views with photographs; no training, the same look from every viewpoint.

REGION is a region's number (--explain lists them), its name in a style file, VIEW:X,Y (a pixel of a view) or VIEW:MASK.png
(what a mask over a view covers); in --pin of Gaussians also a place: box:X,Y,Z:X,Y,Z:BORDER, path:X,Y,Z:X,Y,Z:WIDTH,BORDER or
everywhere. REFERENCE is a file or its number, from 0 in the order given."""


@dataclass(frozen=True, kw_only=True)
class StylizeConfig(StyledRunConfig):
    """Views to restyle, and their style."""

    style: Path | None = None
    """A style file, such as the style.json of an earlier run, of this scene or another; flags come over
    it.
    """
    output: Path | None = None
    """Folder for what is made; by default RUN/styles/NAME, with the name of the style file's folder or of the
    references, and a number behind it where that folder belongs to another style.
    """
    split: Literal["some", "test", "train", "all"] = "some"
    """Views to restyle. some: at most 8 training views, spread evenly; test: those held out from training."""
    views: tuple[str, ...] = ()
    """Views to restyle by name, instead of a split."""
    explain: bool = False
    """Render nothing; list the scene's regions with what each takes: a table, explain.json, explain.png."""
    match_only: bool = False
    """Render nothing; map what each pixel takes: VIEW-match.png, VIEW-score.png, VIEW-confidence.png,
    VIEW-entropy.png.
    """
    matches: bool = True
    """Also write which reference each pixel takes, as VIEW-match.png."""


def run(args: list[str]) -> int:
    """Build the style; explain it, map it, or render the views; write style.json."""
    config, file = read_flags(
        StylizeConfig(), args, prog="fprf stylize", description=_STYLIZE_HELP, positional=("run",)
    )
    from ..style.dictionary import save_dictionary
    from ..style.regions import Regions
    from ..style.restyle import apply_style
    from ..training.loading import open_run

    opened = open_run(config.run, config.device, config)
    scene = opened.scene
    views = opened.known.views(config.split, config.views)
    names = _names(config, [scene.names[view] for view in views])
    if config.explain:
        explained = ["explain.json", "explain.png"]
    else:
        explained = []
    origin = origin_of("stylize", config, file)
    output = _folder(config, origin, [*explained, *names])
    tables = []
    for name in explained:
        tables.append(output / name)
    if (
        config.explain and not config.references and not config.light_asked
    ):  # regions alone: no style is built
        with origin.writing(tables):
            print_explained(output, Regions(scene, *scene.measured()), None)
        return 0
    # The whole style: references encoded and clustered, matched with the scene's regions. Views come after,
    # each on its own.
    start = time.perf_counter()
    styled = apply_style(scene, file)
    made: dict[str, Any] = {
        "dictionary_seconds": time.perf_counter() - start,
        "codes": len(styled.codes.reference),
    }
    for note in (*styled.controls.notes, *scene.restyled(styled.restyle).light_notes):
        print(note)
    saved = styled.controls.saved
    files = []
    for name in names:
        files.append(output / name)
    with origin.writing(tables), origin.writing(files, style_key(saved)) as removed:
        if removed:
            print(f"{output}: {removed} files of the style that was there before are removed")
        if config.explain:
            print_explained(output, styled.controls.regions, styled)
        if config.match_only or not config.explain:
            made |= _make(scene, output, styled, views, config)
        save_dictionary(output / "dictionary.safetensors", styled.dictionary)
        write_style(output / "style.json", saved, made)
    return 0


def _names(config: StylizeConfig, views: Sequence[str]) -> list[str]:
    """Names of the files of the style that are written into its folder."""
    names: list[str] = []
    if config.explain and not config.references and not config.light_asked:
        return names
    if config.match_only:
        kinds = ["-match.png", "-score.png", "-confidence.png", "-entropy.png"]
    elif config.explain:
        kinds = []
    else:
        if config.matches:
            kinds = [".png", "-match.png"]
        else:
            kinds = [".png"]
    for view in views:
        for kind in kinds:
            names.append(f"{view}{kind}")
    return [*names, "dictionary.safetensors", "style.json"]


def _folder(config: StylizeConfig, origin: Origin, names: Sequence[str]) -> Path:
    """The folder that is asked for, else one in the run that belongs to this style alone, said where its name is
    not the usual one.

    Raises UsageError where files of the folder may not be replaced.
    """
    if config.output is not None:
        origin.check(config.output / name for name in names)
        return config.output
    styles = config.run / "styles"
    usual = style_name(config.style, config.references) or config.light_name or "regions"
    taken: list[str] = []
    name = usual
    while not origin.permits(styles / name / each for each in names):
        taken.append(name)
        name = unused_name(usual, taken)
    if taken:
        print(f"{styles / usual} belongs to another style or is read; this one goes to {styles / name}")
    return styles / name


def _make(
    scene: "Scene", output: Path, styled: "Styled", views: list[int], config: StylizeConfig
) -> dict[str, Any]:
    """Pictures and match maps of the views; what was matched and how long it took."""
    from ..io.images import to_uint8, write_image
    from ..style.match_maps import match_map, match_picture, match_pictures, summarize

    shown = not config.match_only
    rendering = 0.0
    matching = 0.0
    summaries = {}
    restyled = scene.restyled(styled.restyle) if shown else scene
    with Display() as display:
        for i, view in enumerate(views):
            display.count(i, len(views), "restyling" if shown else "matching")
            start = time.perf_counter()
            name = scene.names[view]
            if shown:
                picture = restyled.render(scene.cameras, view)
                rendering += time.perf_counter() - start
                write_image(output / f"{name}.png", to_uint8(picture.rgb))
            # Matches are those of the points that the view sees, found apart from its colours.
            if config.match_only or config.matches:
                start = time.perf_counter()
                matched = match_map(scene, styled, view)
                matching += time.perf_counter() - start
                summaries[name] = summarize(matched, styled.codes)
                codes = styled.codes
                if shown:
                    pictures = {"match": match_picture(matched, codes)}
                else:
                    pictures = match_pictures(matched, codes)
                for which, map_picture in pictures.items():
                    write_image(output / f"{name}-{which}.png", map_picture)
        display.count(len(views), len(views), "restyling" if shown else "matching")
    count = max(1, len(views))
    made: dict[str, Any] = {"seconds_per_view": rendering / count} if shown else {}
    made |= {"match_seconds_per_view": matching / count, "matches": summaries}
    if shown:
        what = "views"
        each = rendering / count
    else:
        what = "match maps"
        each = matching / count
    print(f"{len(views)} {what} in {output}  ({each:.2f} s each)")
    return made


def print_explained(output: Path, regions: "Regions", styled: "Styled | None") -> None:
    """Show a scene's regions with what they take: a table on standard output, explain.json and explain.png in
    `output`.
    """
    from ..io.atomic import write_json
    from ..io.images import write_image
    from ..io.maps import contact_sheet
    from ..style.match_maps import explain, region_row, region_tile

    explained = explain(regions, styled)
    names = styled.dictionary.names if styled is not None else ()
    table = [_HEAD if styled else _HEAD[:3]]
    for region in explained:
        cells = [
            str(region.number),
            f"{region.share:.1%}",
            f"{region.view}:{region.pixel[0]},{region.pixel[1]}",
        ]
        if region.taken:
            best = [taken for taken in region.taken if taken.share >= _MIN_TABLE_SHARE][:3] or list(
                region.taken[:1]
            )
            takes = ", ".join(f"{taken.name} {taken.share:.0%} (score {taken.score:.2f})" for taken in best)
            if region.strength == 0:
                strength = "kept"
            else:
                strength = f"{region.strength:.2g}"
            cells += [strength, f"{region.confidence:.0%}", f"{region.entropy:.1f} bit", takes]
        table.append(tuple(cells))
    widths = []
    for column in zip(*table, strict=True):
        widths.append(max(len(cell) for cell in column))
    for row in table:
        print("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    write_json(
        output / "explain.json",
        {"references": list(names), "regions": [region_row(region) for region in explained]},
    )
    write_image(output / "explain.png", contact_sheet([region_tile(region, names) for region in explained]))
    print(f"the same with pictures in {output / 'explain.png'} and explain.json")
