"""Sets of pixels as runs of neighbours: which pixels of a million images may be drawn, in a few numbers a row."""

import copy
from collections.abc import Iterable
from typing import Annotated

import torch
from torch import Tensor

__all__ = ["Runs"]


class Runs:
    """A set of numbers of 0 to 2^63, as K runs that neither touch nor overlap, in order."""

    def __init__(self, start: Annotated[Tensor, "K"], length: Annotated[Tensor, "K"]) -> None:
        self._start = start
        self._after = length.cumsum(0)
        self._before = self._after - length
        self._count = int(self._after[-1]) if len(start) else 0

    @staticmethod
    def of(masks: Iterable[tuple[int, Annotated[Tensor, "P"]]]) -> "Runs":
        """Of masks, each with the number of its first entry, which rise; a run may go on from one mask to the next."""
        starts, ends = [], []
        for first, mask in masks:
            edge = torch.zeros(1, dtype=torch.bool)
            change = torch.cat([edge, mask.reshape(-1), edge]).diff().nonzero()[:, 0] + first
            starts.append(change[::2])
            ends.append(change[1::2])
        none = torch.zeros(0, dtype=torch.int64)
        start, end = torch.cat([none, *starts]), torch.cat([none, *ends])
        apart = torch.ones(len(start) + 1, dtype=torch.bool)
        apart[1:-1] = start[1:] != end[:-1]
        start, end = start[apart[:-1]], end[apart[1:]]
        return Runs(start, end - start)

    def __len__(self) -> int:
        """How many numbers there are."""
        return self._count

    def to(self, device: torch.device) -> "Runs":
        """The same set on a device."""
        there = copy.copy(self)
        there._start, there._after, there._before = (x.to(device) for x in (self._start, self._after, self._before))
        return there

    def pick(self, rank: Annotated[Tensor, "R"]) -> Annotated[Tensor, "R"]:
        """The numbers of these ranks, 0 <= rank < len: the first, second ... of the set."""
        run = torch.searchsorted(self._after, rank, right=True)
        return self._start[run] + rank - self._before[run]

    def holds(self, number: Annotated[Tensor, "R"]) -> Annotated[Tensor, "R"]:
        """Which numbers are in the set."""
        if not len(self._start):
            return torch.zeros_like(number, dtype=torch.bool)
        run = (torch.searchsorted(self._start, number, right=True) - 1).clamp_min(0)
        apart = number - self._start[run]
        return (apart >= 0) & (apart < self._after[run] - self._before[run])
