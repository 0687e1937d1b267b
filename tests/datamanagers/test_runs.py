"""Runs of pixels say what lists of them would."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from fprf.datamanagers.batches import Runs

MASKS = st.lists(st.lists(st.booleans(), min_size=1, max_size=12), max_size=5)


@given(MASKS, st.integers(0, 7))
def test_runs_are_the_list(masks: list[list[bool]], first: int) -> None:
    parts, start, wanted = [], first, []
    for mask in masks:
        parts.append((start, torch.tensor(mask)))
        wanted += [start + k for k, each in enumerate(mask) if each]
        start += len(mask)
    runs = Runs.of(parts)
    assert len(runs) == len(wanted)
    assert runs.pick(torch.arange(len(wanted))).tolist() == wanted
    everything = torch.arange(start + 3)
    assert everything[runs.holds(everything)].tolist() == wanted


def test_whole_masks_are_one_run_together() -> None:
    """Else a scene of many images would need a number for each row."""
    runs = Runs.of((100 * k, torch.ones(100, dtype=torch.bool)) for k in range(50))
    assert len(runs) == 5000 and len(runs._start) == 1


def test_nothing_is_a_set_too() -> None:
    runs = Runs.of([])
    assert len(runs) == 0 and not runs.holds(torch.tensor([0, 5])).any()
    assert len(Runs.of([(4, torch.zeros(9, dtype=torch.bool))])) == 0
