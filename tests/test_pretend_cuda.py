"""The pretended device refuses what CUDA refuses, and counts what makes the host wait or copy."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.ops.backend import float32_convolutions


def ones(*shape: int) -> Tensor:
    return torch.ones(*shape, device=CUDA)


WAITS: dict[str, Callable[[], object]] = {
    "item": lambda: ones(()).item(),
    "bool": lambda: bool(ones(()) > 0),
    "float": lambda: float(ones(())),
    "tolist": lambda: ones(3).tolist(),
    "cpu": lambda: ones(3).cpu(),
    "nonzero": lambda: ones(3).nonzero(),
    "mask": lambda: ones(3)[ones(3) > 0],
    "masked_select": lambda: ones(3).masked_select(ones(3) > 0),
    "unique": lambda: ones(3).unique(),
    "bincount": lambda: ones(3).long().bincount(),
    "equal": lambda: torch.equal(ones(3), ones(3)),
    "copy_": lambda: torch.zeros(3).copy_(ones(3)),
}
UPLOADS: dict[str, Callable[[], object]] = {
    "to": lambda: torch.ones(3).to(CUDA),
    "tensor": lambda: torch.tensor([1.0, 2.0], device=CUDA),
    "as_tensor": lambda: torch.as_tensor([1.0, 2.0], device=CUDA),
    "new_tensor": lambda: ones(3).new_tensor([1.0, 2.0]),
    "copy_": lambda: ones(3).copy_(torch.zeros(3)),
    "list as index": lambda: ones(3)[[0, 2]],
}
FREE: dict[str, Callable[[], object]] = {
    "arithmetic": lambda: (ones(3) + 1) @ ones(3, 2),
    "factories": lambda: torch.full((), 2.0, device=CUDA) + torch.arange(3, device=CUDA),
    "where": lambda: torch.where(ones(3) > 0, ones(3), 0.0),
    "indices": lambda: ones(3)[torch.arange(2, device=CUDA)],
    "one value where a mask is": lambda: ones(3).masked_fill(ones(3) > 0, 2.0),
    "a number of the host": lambda: ones(3) * torch.tensor(2.0),
}


@pytest.mark.parametrize(("what", "name"), [(what, name) for what in (WAITS, UPLOADS, FREE) for name in what])
def test_waits_and_copies_are_counted(what: dict[str, Callable[[], object]], name: str) -> None:
    with pretend_cuda() as seen:
        what[name]()
    assert bool(seen.syncs.total()) == (what is WAITS)
    assert bool(seen.uploads.total()) == (what is UPLOADS)


@pytest.mark.parametrize(
    "wrong",
    [lambda: ones(3) + torch.ones(3), lambda: ones(3).numpy(), lambda: torch.stack([ones(2), torch.ones(2)])],
)
def test_what_cuda_refuses_is_refused(wrong: Callable[[], object]) -> None:
    with pretend_cuda(), pytest.raises((RuntimeError, TypeError)):
        wrong()


def test_convolutions_are_in_tf32_unless_told_otherwise() -> None:
    """As on a card: 1 + 2^-12 becomes 1."""
    x = torch.full((1, 1, 1, 1), 1 + 2**-12)
    with pretend_cuda():
        there = x.to(CUDA)
        assert float(F.conv2d(there, there)) == 1
        with float32_convolutions(CUDA):
            assert float(F.conv2d(there, there)) == float(x * x)
    assert float(F.conv2d(x, x)) == float(x * x)
