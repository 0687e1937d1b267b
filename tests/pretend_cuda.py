"""CUDA's device rules without a GPU: tensors that say `cuda:0`, compute on the CPU, and refuse what a GPU would refuse.

    with pretend_cuda() as seen:
        train(..., device="cuda:0")
    print(seen.syncs)      # what would have made the host wait, by operator

Mixing devices raises, `.numpy()` raises, `.item()`, `nonzero` and copies to the host work and are counted. Real values flow,
so whole training runs, renders and restyles can be driven through it and compared with the CPU. Works with a CPU-only torch.

Name the device with its index ("cuda:0"): a CPU-only torch has no guard that could find the index of "cuda" alone.
What it cannot show: memory, streams, kernels' own faults (Triton: run the same path under TRITON_INTERPRET=1 on `.inner`).
"""

import contextlib
from collections import Counter
from collections.abc import Iterator

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

CUDA = torch.device("cuda:0")
SYNCS = (
    "aten._local_scalar_dense.default",
    "aten.nonzero.default",
    "aten.masked_select.default",
    "aten.equal.default",
    "aten._unique2.default",
)


class Pretended(torch.Tensor):
    """A tensor of the pretended device around one of the CPU."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "Pretended":
        return torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype, device="meta"
        )

    def __init__(self, inner: torch.Tensor) -> None:
        self.inner = inner

    @property
    def device(self) -> torch.device:
        return CUDA

    @property
    def is_cuda(self) -> bool:
        return True

    @property
    def is_cpu(self) -> bool:
        return False

    def cpu(self, *a: object, **k: object) -> torch.Tensor:
        return self.to("cpu")

    def numpy(self, *a, **k):
        raise TypeError(
            "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first."
        )

    def __array__(self, *a, **k):
        return self.numpy()

    def tolist(self):
        return self.to("cpu").tolist()

    def __repr__(self) -> str:
        return f"Pretended({self.inner})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, Counter())


def _run(func, args, kwargs, syncs: Counter):
    name = str(func)
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
    ours = [x for x in tensors if isinstance(x, Pretended)]
    copies = name in ("aten._to_copy.default", "aten.copy_.default")
    if ours and not copies and any(not isinstance(x, Pretended) and x.dim() > 0 for x in tensors):
        raise RuntimeError(
            f"{name}: Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!"
        )
    target = kwargs.get("device")
    there = bool(ours) if target is None else torch.device(target).type != "cpu"
    if ours and (name in SYNCS or (name == "aten._to_copy.default" and not there)):
        syncs[name] += 1
    if name == "aten.copy_.default" and isinstance(args[0], Pretended) != isinstance(args[1], Pretended):
        syncs[name] += 1
    bare = lambda x: x.inner if isinstance(x, Pretended) else x  # noqa: E731
    kwargs = {k: torch.device("cpu") if k == "device" and v is not None else v for k, v in kwargs.items()}
    result = func(*tree_map(bare, args), **tree_map(bare, kwargs))
    if name.split(".")[1].endswith("_") and args and isinstance(args[0], torch.Tensor):
        return args[0]
    return tree_map(
        lambda x: Pretended(x) if there and isinstance(x, torch.Tensor) and not isinstance(x, Pretended) else x, result
    )


class _Mode(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.syncs: Counter = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, self.syncs)


@contextlib.contextmanager
def pretend_cuda() -> Iterator[_Mode]:
    """Within it, `cuda:0` is a device. Generators of it are the CPU's; inference mode is `no_grad`, which wrappers allow."""
    real = torch.Generator

    class Generator:
        def __new__(cls, device="cpu"):
            return real("cpu")

    kept = torch.Generator, torch.inference_mode, torch.cuda._lazy_init, torch.cuda.is_available, torch.cuda.device_count
    torch.Generator, torch.inference_mode = Generator, torch.no_grad
    torch.cuda._lazy_init, torch.cuda.is_available, torch.cuda.device_count = lambda: None, lambda: True, lambda: 1
    try:
        with _Mode() as mode:
            yield mode
    finally:
        torch.Generator, torch.inference_mode, torch.cuda._lazy_init, torch.cuda.is_available, torch.cuda.device_count = kept
