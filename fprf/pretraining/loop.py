"""The training loop of every pretraining: Adam, one cosine to zero by time or steps, checkpoints, report and sample pictures.

A batch is a function of (seed, step), so that a resumed run goes on as the interrupted one would have. Prepared crops and
targets are kept beside the output until the run is finished.
"""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor, nn

from ..io.atomic import write_json
from ..io.images import to_uint8, write_image
from ..plugins.weights import read_weights, write_weights
from .config import PretrainConfig

GAP = 4
"""Pixels between the pictures of a sheet."""


def report_path(output: Path) -> Path:
    """Path of the report of these weights."""
    return output.with_name(output.stem + ".report.json")


def samples_folder(output: Path) -> Path:
    """Folder of the sample pictures of these weights."""
    return output.with_name(output.stem + ".samples")


def write_report(output: Path, kind: str, report: Mapping[str, float | int | str]) -> Path:
    """Write the report, whole or not at all; the weights by their bare name, since both may be moved."""
    path = report_path(output)
    write_json(path, {"kind": kind, **report, "weights": output.name})
    return path


def sheet(rows: Sequence[Sequence[Annotated[Tensor, "H W 3"]]]) -> Annotated[Tensor, "H W 3"]:
    """Pictures of any sizes in rows, on white, aligned at their top left corners: one picture of all."""
    height = [max(picture.shape[0] for picture in row) for row in rows]
    width = [max(row[i].shape[1] for row in rows if i < len(row)) for i in range(max(len(row) for row in rows))]
    whole = torch.ones(sum(height) + GAP * (len(rows) - 1), sum(width) + GAP * (len(width) - 1), 3)
    for y, row in enumerate(rows):
        top = sum(height[:y]) + GAP * y
        for x, picture in enumerate(row):
            left = sum(width[:x]) + GAP * x
            whole[top : top + picture.shape[0], left : left + picture.shape[1]] = picture.detach().to(whole)
    return whole


WARM_UP = 0.02
"""Share of the run in which the rate rises."""
EVERY_SECONDS = 60.0
Say = Callable[[str], None]


@dataclass
class _Progress:
    step: int = 0
    seconds: float = 0.0

    def done(self, config: PretrainConfig) -> float:
        """Finished share of the run, 0 to 1."""
        if config.steps is not None:
            return min(1.0, self.step / config.steps)
        return min(1.0, self.seconds / (60 * config.minutes))


def generator_of(seed: int, step: int) -> torch.Generator:
    """The generator of one step. Only 32 bits of a seed count, so seeds are spread over them."""
    return torch.Generator().manual_seed((seed * 0x9E3779B1 + step) % (1 << 32))


def checkpoint_path(output: Path) -> Path:
    """Path of the state of an unfinished run."""
    return output.with_name(output.name + ".checkpoint")


def train(
    network: nn.Module,
    loss: Callable[[torch.Generator], Tensor],
    config: PretrainConfig,
    output: Path,
    say: Say,
    picture: Callable[[], Annotated[Tensor, "H W 3"]] | None = None,
) -> int:
    """Train in place until the budget is spent; the number of steps. `loss` draws its batch from the generator.

    `picture` shows what the network can do, in [0, 1]: it is written to `samples_folder` every `config.samples` seconds and
    at the end.
    """
    optimizer = torch.optim.Adam(network.parameters(), config.rate)
    progress = _resume(network, optimizer, config, output)
    if progress.step:
        say(f"resumed at step {progress.step}")
    network.train()
    started, saved, spoken = time.monotonic() - progress.seconds, time.monotonic(), 0.0
    shown = saved
    while (done := progress.done(config)) < 1:
        optimizer.param_groups[0]["lr"] = config.rate * min(1.0, done / WARM_UP + 0.01) * 0.5 * (1 + math.cos(math.pi * done))
        value = loss(generator_of(config.seed, progress.step))
        optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        progress.step += 1
        now = time.monotonic()
        progress.seconds = now - started
        if now - spoken > EVERY_SECONDS / 4:
            say(f"step {progress.step}  {100 * done:.0f} %  loss {value.item():.5f}")
            spoken = now
        if now - saved > EVERY_SECONDS:
            _save(network, optimizer, config, output, progress)
            saved = now
        if picture is not None and config.samples > 0 and now - shown > config.samples and progress.done(config) < 1:
            _show(picture, output, progress.step)
            shown = now
    network.eval()
    if picture is not None and config.samples > 0:
        _show(picture, output, progress.step)
    checkpoint_path(output).unlink(missing_ok=True)
    return progress.step


@torch.no_grad()
def _show(picture: Callable[[], Tensor], output: Path, step: int) -> None:
    write_image(samples_folder(output) / f"step-{step:07d}.png", to_uint8(picture()))


def _key(config: PretrainConfig) -> str:
    return repr(replace(config, samples=0.0, device="auto"))


def _save(network: nn.Module, optimizer: torch.optim.Adam, config: PretrainConfig, output: Path, progress: _Progress) -> None:
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value for name, value in moments.items()}
    metadata = {"config": _key(config), "progress": json.dumps([progress.step, progress.seconds])}
    write_weights(checkpoint_path(output), tensors, metadata)


def _resume(network: nn.Module, optimizer: torch.optim.Adam, config: PretrainConfig, output: Path) -> _Progress:
    """Continue the run of the same config; any other checkpoint is left alone and overwritten in time."""
    path = checkpoint_path(output)
    if not path.is_file():
        return _Progress()
    tensors, metadata = read_weights(path)
    if metadata.get("config") != _key(config):
        return _Progress()
    network.load_state_dict({name[8:]: value for name, value in tensors.items() if name.startswith("network.")})
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, moment = name.split(".")
            state.setdefault(int(index), {})[moment] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    step, seconds = json.loads(metadata["progress"])
    return _Progress(step=step, seconds=seconds)
