"""Trained blocks on disk, fetched when points fall into them and put back when memory is short.

Files are memory-mapped: a block that is put back costs nothing to keep and little to fetch again. Checksums are verified the
first time that a process meets a block.
"""

import copy
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from ..blocks.fields import Member, Members
from ..blocks.routing import chart_of
from ..types import Boxes
from .blocks import folder_of, load_finished, restore

__all__ = ["Shelf"]


class Shelf(Members):
    """Blocks of a run, the last used first; the surroundings always at hand."""

    def __init__(
        self,
        root: Path,
        boxes: Boxes,
        around: Member,
        *,
        device: torch.device,
        limit: int | None,
        told: Callable[[int], None] = lambda block: None,
    ) -> None:
        self._root, self._boxes, self._around = root, boxes, around
        self._device, self._told = device, told
        self._here: OrderedDict[int, Member] = OrderedDict()
        self._verified: set[int] = set()
        size = sum(t.numel() * t.element_size() for t in around.state_dict().values())
        self._room = None if limit is None else max(1, limit // size - 1)

    @property
    def held(self) -> Sequence[Member]:
        """The surroundings."""
        return (self._around,)

    @property
    def here(self) -> tuple[int, ...]:
        """Blocks in memory, the least recently used first."""
        return tuple(self._here)

    def member(self, number: int) -> Member:
        """A block by its number; the surroundings come after the last one. Raises CheckpointError for a missing block."""
        if number == len(self._boxes.low):
            return self._around
        if number in self._here:
            self._here.move_to_end(number)
            return self._here[number]
        while self._room is not None and len(self._here) >= self._room:
            self._here.popitem(last=False)
        self._here[number] = found = self._fetch(number)
        return found

    def _fetch(self, number: int) -> Member:
        self._told(number)
        member = copy.deepcopy(self._around)
        member.chart = chart_of(self._boxes, number)
        finished = load_finished(folder_of(self._root, number), verify=number not in self._verified)
        restore(member, "member", finished.tensors)
        self._verified.add(number)
        return member.requires_grad_(False).to(self._device).eval()
