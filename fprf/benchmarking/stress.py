"""`fprf bench stress`: every stage on adversarial inputs, each against a reference and a bound."""

from collections.abc import Callable
from pathlib import Path

from ..io.atomic import write_text
from ..stress import files, pipeline, rays, styles
from ..stress.check import Check, markdown
from .config import StressConfig
from .report import Outcome, machine, table
from .subject import attempt, find, settings, test_view

__all__ = ["stress"]

Progress = Callable[[int, int, str], None]


def stress(config: StressConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """All rows; `falls_short` of the document names those whose bound is broken."""
    subject = find(root, config, folder)
    trained = subject.trained
    prepared, missing = attempt(subject)
    scene = prepared.scene if prepared is not None else None
    stages: dict[str, Callable[[], list[Check]]] = {
        "rendering": rays.weights,
        "sampling": rays.sampling,
        "statistics": styles.statistics,
        "clusters": styles.clusters,
        "matching": styles.matching,
        "stylizers": styles.stylizers,
        "guided filter": styles.guided,
        "readers": lambda: files.readers(folder / "files", config.mutations, config.seed),
        "damage": lambda: files.damage(folder / "damage", config.flips, config.seed),
        "pipeline": lambda: pipeline.invariants(trained, scene, test_view(config, trained), subject.references),
    }
    checks: list[Check] = []
    for number, (name, run) in enumerate(stages.items()):
        progress(number, len(stages), name)
        checks += run()
    progress(len(stages), len(stages), "stress")
    broken = [check for check in checks if not check.passed]
    document = {
        "benchmark": "stress",
        "settings": settings(config, trained, missing),
        "machine": machine(trained.model.device),
        "rows": [check.json() for check in checks],
        "falls_short": [f"{check.stage}: {check.input}" for check in broken],
    }
    if config.markdown is not None:
        write_text(config.markdown, markdown(checks))
    title = f"{len(checks)} checks, {len(broken)} broken"
    shown = table(title, ("", "input", "reference", "bound", "measured", ""), (_cells(check) for check in checks))
    return Outcome(document, [shown])


def _cells(check: Check) -> list[str]:
    bound = f"{'≥' if check.at_least else '≤'} {check.bound:.3g} {check.unit}"
    return [check.stage, check.input, check.reference, bound, f"{check.measured:.3g}", "" if check.passed else "BROKEN"]
