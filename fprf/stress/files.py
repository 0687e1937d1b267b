"""Files gone bad: every reader on mutated files, and flipped bits in what a run keeps."""

import random
from pathlib import Path

import torch

from ..errors import FprfError
from ..testing import cases
from ..training import tensorfiles
from .check import Check
from .fuzz import fuzz
from .readers import targets

__all__ = ["damage", "readers"]


def readers(folder: Path, rounds: int, seed: int) -> list[Check]:
    """So many mutations for each reader."""
    rows = []
    for target in targets(folder):
        found = fuzz(target, rounds, seed)
        told = f"{rounds} mutations: {found.values} read, {found.refusals} refused in one line"
        rows.append(_row(f"{target.name}, {told}", "a value or one line", len(found.faults), 0, "others"))
    return rows


def damage(folder: Path, flips: int, seed: int) -> list[Check]:
    """Flipped bits in a file of tensors with its checksums."""
    folder.mkdir(parents=True, exist_ok=True)
    path, draw = folder / "sealed.safetensors", random.Random(seed)  # nosec B311  # no secrets
    made = {"planes": cases.normal(16, 64), "mean": cases.normal(64), "step": torch.tensor([7])}
    tensorfiles.save_sealed(path, made)
    whole = path.read_bytes()
    found = wrong = 0
    for _ in range(flips):
        raw = bytearray(whole)
        raw[draw.randrange(len(raw))] ^= 1 << draw.randrange(8)
        path.write_bytes(raw)
        try:
            read = tensorfiles.load_sealed(path)
        except FprfError:
            found += 1
        else:
            wrong += any(name not in read or not torch.equal(read[name], t) for name, t in made.items())
    return [_row(f"{flips} flipped bits in sealed tensors, {found} refused", "never wrong numbers", wrong, 0, "wrong")]


def _row(name: str, reference: str, measured: float, bound: float, unit: str) -> Check:
    return Check(stage="files", input=name, reference=reference, measured=measured, bound=bound, unit=unit)
