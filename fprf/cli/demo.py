"""`fprf demo`: a garden from photographs to a page that shows it restyled. No network, no data."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

from ..checks import at_least, positive
from ..io.overwriting import Origin, OverwriteConfig
from ..light.day import check_suns
from ..progress import Display
from ..style.config import StyleConfig
from ..style.files import StyleFile
from .gallery import page_styles, page_views
from .parsing import parse

TITLE = "One garden, photographed once"
LEAD = (
    "Trained on a CPU from 25 photographs. Each look is then taken from one photograph, without training, and is the same "
    "from every viewpoint."
)
LOOKS = ("Sunrise", "Morning", "Sunset", "Night")
"""References, in the order in which they are shown."""
ALL_TOGETHER = "All together"
"""Name of the style of all references."""
CREDITS = (
    "Photographs of the garden: The SfM Tool Authors (sfmtool/sfmtool, test-data), Apache-2.0; reduced and re-encoded.",
    "Sunrise, morning, sunset and night: crops of panoramas by Greg Zaal (HDRI Haven, now Poly Haven), CC0.",
)


@dataclass(frozen=True, kw_only=True)
class DemoConfig(OverwriteConfig):
    """A garden in Seattle: train, measure, restyle, and one page that shows it."""

    output: Path = Path("demo")
    """Folder for everything that the demo makes."""
    minutes: float = 1.15
    """Training time."""
    downscale: int | float = 1
    """The photographs, 356x634, are reduced by this factor."""
    megabytes: float = 4.8
    """Size of the page, at most; Gaussians that show least are left out of it."""
    suns: int = 12
    """Suns of a day on the page, from 2 to 64; one chooses the time there. 0 = none."""

    def __post_init__(self) -> None:
        positive("minutes", self.minutes)
        positive("megabytes", self.megabytes)
        check_suns(self.suns)
        at_least("downscale", self.downscale, 1)


def run(args: list[str]) -> int:
    """Train the garden, or resume, then measure, restyle, export and write the page."""
    config = parse(
        DemoConfig(),
        args,
        prog="fprf demo",
        description="Train, restyle and show a garden that ships with fprf.",
    )
    start = time.perf_counter()
    from ..datamanagers.images import load_preview
    from ..io.atomic import write_json
    from ..methods import fprf_splats
    from ..page import GARDEN
    from ..page.writer import REFERENCE_PIXELS, Page, Reference, write_page
    from ..rendering.local_frame import offset_file
    from ..splats.files import write_gaussians
    from ..splats.loading import open_gaussians
    from ..splats.scene import SplatScene
    from ..training.driver import train
    from ..training.quality import QualityConfig
    from ..training.run import Run
    from .eval import EvalConfig, evaluate

    output = config.output / "run"
    captures = {}
    for name in (*LOOKS, ALL_TOGETHER):
        captures[name] = config.output / f"{name.lower().replace(' ', '-')}.ply"
    page = config.output / "garden.html"
    table = config.output / "metrics.json"
    origin = Origin(by="demo", overwrite=config.overwrite)
    outputs = [page, table, *captures.values(), *map(offset_file, captures.values())]
    origin.check(outputs)
    training = replace(
        fprf_splats(), data=GARDEN, downscale=config.downscale, output=output, minutes=config.minutes
    )
    root = train(training, "fprf-splats")
    metrics = evaluate(EvalConfig(run=root, images=False))
    opened = open_gaussians(Run(root), training, "cpu", QualityConfig())
    scene = opened.scene
    views = opened.known.test
    names = {}
    for name in LOOKS:
        names[GARDEN / "references" / f"{name.lower()}.jpg"] = name
    chosen = []
    for path, name in names.items():
        chosen.append((name, StyleFile(StyleConfig(references=(path,)))))
    chosen.append((ALL_TOGETHER, StyleFile(StyleConfig(references=tuple(names)))))
    with origin.writing(outputs), Display() as display:
        begun = time.perf_counter()
        scene.measured()
        looked = time.perf_counter() - begun
        styles = page_styles(scene, chosen, views, names, display)
        for style, look, _ in styles:
            assert isinstance(look, SplatScene)
            # For viewers that do not compensate opacities; these depend on no colour, so that the views are
            # looked at once.
            plain = scene.seen.plain(look.shown)
            write_gaussians(captures[style.name], plain, origin=scene.origin)
        shown_views = page_views(opened, views, display)
        # Of the single styles: the one of all together encodes nothing anew.
        metrics |= {
            "looked_seconds": looked,
            "new_style_seconds": fmean(seconds for *_, seconds in styles[: len(LOOKS)]),
            "total_seconds": time.perf_counter() - start,
        }
        write_json(table, metrics)
        width, height = (int(v) for v in scene.cameras.size[0])
        content = Page(
            title=TITLE,
            lead=LEAD,
            facts={
                "Photographs": len(scene.names),
                "Size": f"{width} × {height}",
                "Trained for": f"{opened.seconds:.0f} s",
                "Unseen views": f"{metrics['psnr']:.1f} dB",
                "A new style": f"{metrics['new_style_seconds']:.1f} s",
            },
            views=shown_views,
            styles=[style for style, *_ in styles],
            references=[
                Reference(name, load_preview(path, REFERENCE_PIXELS)) for path, name in names.items()
            ],
            scene=scene,
            start=views[0],
            suns=config.suns,
            credits=CREDITS,
        )
        write_page(page, content, megabytes=config.megabytes)
    print(
        f"PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.3f}; a new style in {metrics['new_style_seconds']:.2f} s; "
        f"all in {metrics['total_seconds']:.0f} s\n"
        f"open {page}; {config.output}/*.ply open in any viewer of Gaussians"
    )
    return 0
