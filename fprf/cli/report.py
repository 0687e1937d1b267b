"""`fprf report RUN`: how training went, as a page of charts and a line each on the terminal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ..errors import CheckpointError
from ..io.strict_json import parse_json
from .parsing import parse

if TYPE_CHECKING:
    from ..training.run import History

_PLAIN = {"psnr": "PSNR", "rays_per_second": "rays a second", "kept": "samples kept", "skipped_steps": "skipped steps"}
"""Labels of figures that are no losses."""
_UNITS = {"psnr": "dB", "kept": "share"}


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """Settings of `fprf report`."""

    run: Path = Path()
    """Run folder; one in training will do."""
    output: Path | None = None
    """The page; by default RUN/report.html."""
    tensorboard: Path | None = None
    """A folder for event files of TensorBoard as well (extra tensorboard): `tensorboard --logdir` shows them."""


def run(args: list[str]) -> int:
    """Read the events, write the page, print the lines."""
    description = "Loss, PSNR, speed and time per part of a run, as RUN/report.html and a line each here."
    config = parse(ReportConfig(), args, prog="fprf report", description=description, positional=("run",))
    if not config.run.is_dir():
        raise CheckpointError(f"{config.run}: no such folder; give a run folder, as `fprf train` makes it")
    from ..io.report import bar_chart, write_report
    from ..training.run import read_history

    histories = read_history(config.run)
    parts = _parts(config.run, histories)
    output = config.output if config.output is not None else config.run / "report.html"
    notes = [f"{history.name}: {note}" if history.name else note for history in histories for note in history.notes]
    write_report(
        output,
        title=config.run.resolve().name,
        facts=_facts(config.run, histories),
        charts=_charts(histories),
        parts=bar_chart([(name, seconds, _clock(seconds)) for name, seconds in parts]),
        notes=notes,
    )
    _print(histories, parts, notes)
    print(f"charts in {output}")
    if config.tensorboard is not None:
        from ..io.report import write_scalars

        count = write_scalars(config.tensorboard, histories)
        print(f"{count} values in {config.tensorboard}: tensorboard --logdir {config.tensorboard}")
    return 0


def _charts(histories: "Sequence[History]") -> list[str]:
    """PSNR, speed, and every loss."""
    from ..io.report import Series, line_chart

    names = list(dict.fromkeys(name for history in histories for name in history.values))
    made = []
    for name in sorted(names, key=lambda name: (name not in _PLAIN, names.index(name))):
        series = [Series(h.name or name, h.step, h.values[name]) for h in histories if name in h.values]
        loss = name not in _PLAIN
        if name == "skipped_steps" and not any(value for each in series for value in each.y):
            continue
        title = f"{name.replace('_', ' ')} loss" if loss else _PLAIN[name]
        made.append(line_chart(title, series, "step", "logarithmic" if loss else _UNITS.get(name, "running mean"), log=loss))
    return [chart for chart in made if chart]


def _facts(run: Path, histories: "Sequence[History]") -> dict[str, str | int | float]:
    facts: dict[str, str | int | float] = {}
    about = _json(run / "config.json")
    if isinstance(about.get("method"), str):
        facts["Method"] = about["method"]
    facts["Steps"] = sum(history.step[-1] for history in histories if history.step)
    facts["Training"] = _clock(sum(history.seconds[-1] for history in histories if history.seconds))
    if len(histories) > 1:
        facts["Trainings"] = len(histories)
    measured = _json(run / "metrics.json")
    for key, label in (("psnr", "PSNR, held out"), ("ssim", "SSIM, held out")):
        if isinstance(measured.get(key), int | float):
            facts[label] = float(measured[key])
    return facts


def _parts(run: Path, histories: "Sequence[History]") -> list[tuple[str, float]]:
    """Seconds of training's parts, of `fprf eval` and of each style that was made, where they are known."""
    parts: dict[str, float] = {}
    for history in histories:
        for name, seconds in history.parts.items():
            parts[name] = parts.get(name, 0.0) + seconds
    if "training" not in parts:  # runs of before the parts were told
        parts["training"] = sum(history.seconds[-1] for history in histories if history.seconds)
    judged = _json(run / "metrics.json").get("render_seconds")
    if isinstance(judged, int | float):
        parts["rendering for eval"] = float(judged)
    for file in sorted(run.glob("styles/*/style.json")):
        made = _json(file).get("made")
        built = made.get("dictionary_seconds") if isinstance(made, dict) else None
        if isinstance(built, int | float):
            parts[f"style {file.parent.name}"] = float(built)
    return list(parts.items())


def _print(histories: "Sequence[History]", parts: list[tuple[str, float]], notes: list[str]) -> None:
    from ..io.report import number, sparkline

    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
    for history in histories:
        for name, values in history.values.items():
            known = [value for value in values if value is not None]
            if not known or (name == "skipped_steps" and not any(known)):
                continue
            label = _PLAIN.get(name, f"{name} loss")
            if history.name:
                label = f"{history.name}: {label}"
            table.add_row(
                label.replace("_", " "), sparkline(values), f"{number(known[0])} → {number(known[-1])}", _UNITS.get(name, "")
            )
    total = sum(seconds for _, seconds in parts) or 1.0
    for name, seconds in parts:
        table.add_row(name, "", _clock(seconds), f"{seconds / total:.0%} of the time")
    console = Console(highlight=False, width=max(100, Console().width))
    console.print(table)
    for note in notes:
        console.print(note, markup=False, soft_wrap=True)


def _json(path: Path) -> dict[str, Any]:
    """A JSON object beside the events; an empty one where it is absent or damaged: the report goes without."""
    try:
        content = parse_json(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _clock(seconds: float) -> str:
    if seconds < 10:
        return f"{seconds:.2f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    hours, rest = divmod(round(seconds), 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d} min"
