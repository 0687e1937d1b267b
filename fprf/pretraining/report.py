"""What a pretraining leaves beside its weights: a report as JSON and a folder of sample pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..io.atomic import write_json

__all__ = ["report_path", "samples_folder", "sheet", "write_report"]

GAP = 4
"""Pixels between the pictures of a sheet."""


def report_path(output: Path) -> Path:
    """Where the report of these weights lies."""
    return output.with_name(output.stem + ".report.json")


def samples_folder(output: Path) -> Path:
    """Where the sample pictures of these weights lie."""
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
