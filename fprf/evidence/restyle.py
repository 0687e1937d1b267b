"""Ground-truth restyling: references of other towns, every method, the town itself in that light."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from ..errors import UsageError
from ..evaluation.steadiness import steadiness
from ..io.images import Picture, to_uint8, write_image
from ..style.references import Encoders
from ..training.loading import load_run
from .codes import Matched, code_classes, match_rates, winners
from .config import RestyleConfig
from .contact import contact_sheet
from .methods import FLAT, GLOBAL, PLAIN, Shown, dictionary_of, in_scene, lineup, nothing, one_by_one, transfers
from .references import Reference, photograph, places
from .scores import Row, best_class_maps, mean_rows, score, true_class_maps
from .stage import Stage, set_stage, true_views

__all__ = ["BOUND", "GOALS", "MATCHED", "Case", "cases", "restyle", "restyle_sheet", "verdict"]

MATCHED, BOUND = "true classes", "best class maps"
"""No methods: they know classes, or even the truth (see `scores`)."""
GOALS: Mapping[str, float] = {
    "over_no_change_db": 3.0,
    "over_best_global_db": 1.5,
    "over_2d_db": 1.5,
    "match_inside": 0.90,
    "consistency": 0.05,
}
"""PSNR of the recommended stylizer with three references against no change, the best of GLOBAL, and itself on single pictures,
at least; its match rate inside of things, at least; its score of consistency, at most."""
JUDGED = "three"
LPIPS_MISSING = "its weights do not ship with the package, and no dependency brings them"
"""Why that figure is null."""

Progress = Callable[[int, int, str], None]


class Case(NamedTuple):
    """One palette with one set of references."""

    light: str
    set: str
    references: list[Reference]
    truth: list[Tensor]
    shown: dict[str, list[Tensor]]
    """The judged views by method."""
    rows: dict[str, Row]
    classes: dict[str, dict[str, float]]
    """ΔE2000 by method and class."""


def restyle(config: RestyleConfig, root: Path, folder: Path, progress: Progress) -> tuple[dict[str, Any], list[Case]]:
    """The document and the cases. `folder` takes the references' files."""
    trained = load_run(root, config.device)
    stage = set_stage(trained, views=config.views, frames=config.frames, longest=config.longest)
    found = cases(config, stage, trained.encoders(), folder, progress)
    sets = sorted({case.set for case in found}, key=[case.set for case in found].index)
    means = {name: mean_rows([case.rows for case in found if case.set == name]) for name in sets}
    best = list(lineup(config.stylizer))[-1]
    document = {
        "benchmark": "restyle",
        "settings": {
            "method": trained.method,
            "trained_steps": trained.step,
            "train_seconds": round(trained.seconds, 1),
            "town_seed": stage.settings.seed,
            "trained_palette": stage.settings.palette,
            "reference_seeds": list(config.seeds),
            "seed": trained.config.seed,
            "views": len(stage.views),
            "frames": len(stage.path),
            "view_size": [int(side) for side in stage.views.size[0]],
            "clusters": config.clusters,
            "blend": config.blend,
            "regions": trained.config.statistics.regions,
            "semantic_encoder": trained.known.facts.semantic_encoder,
        },
        "lpips": None,
        "lpips_missing": LPIPS_MISSING,
        "recommended": best,
        "reconstruction": _own_look(stage),
        "means": means,
        "verdict": verdict(means[JUDGED], best),
        "palettes": {
            light: {case.set: {"rows": case.rows, "delta_e_by_class": case.classes} for case in found if case.light == light}
            for light in config.palettes
        },
    }
    return document, found


def restyle_sheet(found: Sequence[Case]) -> Picture:
    """A row for each palette: three references, the truth, the first view by every method."""
    rows = [case for case in found if case.set == JUDGED]
    columns = [*("reference" for _ in rows[0].references), "truth", *rows[0].shown]
    pictures = {
        case.light: [*(r.image for r in case.references), case.truth[0], *(views[0] for views in case.shown.values())]
        for case in rows
    }
    return contact_sheet(pictures, columns, height=min(120, rows[0].truth[0].shape[0]))


def cases(config: RestyleConfig, stage: Stage, encoders: Encoders, folder: Path, progress: Progress) -> list[Case]:
    """Every palette with every set of references. Raises UsageError for references that would show the run's own town."""
    if stage.settings.seed in config.seeds:
        raise UsageError(f"--seeds: {stage.settings.seed} is the town of the run itself; references show other towns")
    width, height = (int(side) for side in stage.trained.known.cameras.size[0])
    chosen = places(config.seeds, (width, height))
    total = len(config.palettes) * len(chosen)
    found: list[Case] = []
    for light in config.palettes:
        truth = true_views(stage, light)
        for name, where in chosen.items():
            progress(len(found), total, f"restyling, {light}")
            references = [photograph(place, light) for place in where]
            paths = [folder / f"{name}-{reference.name}.png" for reference in references]
            for path, reference in zip(paths, references, strict=True):
                write_image(path, to_uint8(reference.image))
            found.append(_case(config, stage, encoders, (light, name), references, paths, truth))
    progress(total, total, "restyling")
    return found


def verdict(rows: Mapping[str, Row], best: str) -> dict[str, Any]:
    """What the recommended stylizer reaches of GOALS."""
    ours = rows[best]
    baseline = max(GLOBAL, key=lambda name: rows[name]["psnr"] or -math.inf)
    reached = {
        "over_no_change_db": _less(ours["psnr"], rows[PLAIN]["psnr"]),
        "over_best_global_db": _less(ours["psnr"], rows[baseline]["psnr"]),
        "over_2d_db": _less(ours["psnr"], rows[FLAT]["psnr"]),
        "match_inside": ours["match_inside"],
        "consistency": ours["consistency"],
    }
    met = {
        name: None if value is None else value <= goal if name == "consistency" else value >= goal
        for (name, goal), value in zip(GOALS.items(), reached.values(), strict=True)
    }
    return {"goals": dict(GOALS), "reached": reached, "met": met, "best_global": baseline}


def _case(
    config: RestyleConfig,
    stage: Stage,
    encoders: Encoders,
    names: tuple[str, str],
    references: list[Reference],
    paths: Sequence[Path],
    truth: list[Tensor],
) -> Case:
    trained, views = stage.trained, [*stage.shown, *stage.passed]
    dictionary, spent = dictionary_of(trained, paths, encoders, clusters=config.clusters, blend=config.blend)
    stylizers = lineup(config.stylizer)
    best = list(stylizers)[-1]
    found = {PLAIN: nothing(views)}
    plain = found[PLAIN].pictures
    found |= transfers(plain, [reference.image for reference in references])
    found[FLAT] = one_by_one(trained, plain, config.stylizer, dictionary, encoders)
    for name, stylizer in stylizers.items():
        found[name] = in_scene(trained, views, stylizer, dictionary, encoders, paths)
    known = {path.name: reference for path, reference in zip(paths, references, strict=True)}
    classes = code_classes(dictionary, known, encoders, trained.config.datamanager.guided)
    count = len(stage.shown)
    rows, by_class, shown = {}, {}, {name: each.pictures[:count] for name, each in found.items()}
    labels = [each.labels for each in stage.truth]
    known_plain = list(zip(plain[:count], labels, strict=True))
    shown[MATCHED] = true_class_maps(known_plain, [(reference.image, reference.classes) for reference in references])
    shown[BOUND] = best_class_maps(known_plain, truth)
    for name in [*(each for each in shown if each != best), best]:
        rows[name], by_class[name] = score(shown[name], truth, labels)
        rows[name] |= _rest(stage, found.get(name), plain[count:], classes, references, spent)
    return Case(*names, references, truth, {name: shown[name] for name in rows}, rows, by_class)


def _rest(
    stage: Stage,
    method: Shown | None,
    plain_path: Sequence[Tensor],
    classes: Tensor,
    references: Sequence[Reference],
    spent: float,
) -> Row:
    """Match rates, consistency and seconds; None where a method has none."""
    row: Row = dict.fromkeys((*Matched._fields, "consistency", "warp_short", "warp_long", "style_seconds", "view_seconds"))
    if method is None:
        return row
    count = len(stage.shown)
    if method.taken is not None:
        truth = [each.labels for each in stage.truth]
        taken = [winners(share, classes).view(like.shape) for share, like in zip(method.taken[:count], truth, strict=True)]
        row |= match_rates(taken, truth, references)._asdict()
        row["style_seconds"] = method.style_seconds + spent
    depths = [each.depth for each in stage.path_truth]
    steady = steadiness(plain_path, method.pictures[count:], depths, stage.path)
    row |= {"consistency": steady.score, "warp_short": steady.short, "warp_long": steady.long}
    row["view_seconds"] = method.view_seconds
    return row


def _own_look(stage: Stage) -> Row:
    truth = true_views(stage, stage.settings.palette)
    return score([view.restyled().rgb for view in stage.shown], truth, [each.labels for each in stage.truth])[0]


def _less(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b
