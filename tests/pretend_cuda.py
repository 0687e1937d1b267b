"""CUDA's device rules without a GPU: tensors that say `cuda:0`, compute on the CPU, and refuse what a GPU
would refuse.

    with pretend_cuda() as seen:
        train(..., device="cuda:0")
    print(seen.syncs)      # what would have made the host wait, by operator
    print(seen.uploads)    # copies from the host to the device, by operator

Mixing devices raises, `.numpy()` raises, `.item()`, `nonzero`, indexing by a mask and copies to the host work
and are counted. Real values flow, so whole training runs, renders and restyles can be driven through it and
compared with the CPU. Works with a CPU-only torch.

Name the device with its index ("cuda:0"): a CPU-only torch has no guard that could find the index of "cuda"
alone; `auto` names it. Convolutions round their factors to TF32 unless torch is told otherwise, as on a card;
their gradients do not.

What it cannot show: memory (`mem_get_info` answers `memory`), streams, CUDA's own draws (generators are the
CPU's), autocast (wrappers have no autocast key), and other threads: operators there are neither counted nor
pretended. Numbers that reach a kernel as arguments (`x + 1.0`, `torch.full`) are no copies, on a card
neither.
"""

import contextlib
import sys
from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from fprf.ops.triplane import _compiles

CUDA = torch.device("cuda:0")
_ABSENT = object()
MPS = torch.device("mps:0")
SYNCS = (
    "aten._local_scalar_dense.default",
    "aten.nonzero.default",
    "aten.masked_select.default",
    "aten.equal.default",
    "aten._unique2.default",
    "aten.unique_dim.default",
    "aten.unique_consecutive.default",
    "aten.bincount.default",
    "aten.repeat_interleave.Tensor",
    "aten._linalg_svd.default",
    "aten._linalg_eigh.default",
    "aten._linalg_check_errors.default",
)
RESHAPED = ("squeeze_", "unsqueeze_", "t_", "transpose_")
CONVOLUTION = "aten.convolution.default"
INDEXED = (
    "aten.index.Tensor",
    "aten.index_put.default",
    "aten.index_put_.default",
    "aten._index_put_impl_.default",
)


class Pretended(torch.Tensor):
    """A tensor of the pretended device around one of the CPU."""

    inner: torch.Tensor
    where = CUDA

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "Pretended":
        return torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device="meta",
        )

    def __init__(self, inner: torch.Tensor) -> None:
        self.inner = inner

    @property
    def device(self) -> torch.device:
        return self.where

    @property
    def is_cuda(self) -> bool:
        return self.where == CUDA

    @property
    def is_cpu(self) -> bool:
        return False

    @property
    def is_meta(self) -> bool:
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

    def new_tensor(self, data, dtype=None, device=None, requires_grad=False):
        where = self.where if device is None else device
        return torch.tensor(data, dtype=dtype or self.dtype, device=where, requires_grad=requires_grad)

    def __repr__(self) -> str:
        return f"Pretended({self.inner})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, Counter(), Counter())


def _run(func, args, kwargs, syncs: Counter, uploads: Counter):
    name = str(func)
    tensors: list[torch.Tensor] = []
    _each((args, tuple(kwargs.values())), lambda x: tensors.append(x) or x)
    ours = any(isinstance(x, Pretended) for x in tensors)
    indexed = name in INDEXED
    if indexed and isinstance(args[0], Pretended):
        # As CUDA does: indices of the host are copied.
        for x in args[1]:
            if isinstance(x, torch.Tensor) and not isinstance(x, Pretended):
                uploads[name] += 1
                tensors = [other for other in tensors if other is not x]
    copies = name in ("aten._to_copy.default", "aten.copy_.default")
    if ours and not copies and any(not isinstance(x, Pretended) and x.dim() > 0 for x in tensors):
        raise RuntimeError(
            f"{name}: Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!"
        )
    target = kwargs.get("device")
    there = ours if target is None else torch.device(target).type != "cpu"
    if name == "aten._to_copy.default" and ours != there:
        (uploads if there else syncs)[name] += 1
    elif name == "aten.copy_.default" and isinstance(args[0], Pretended) != isinstance(args[1], Pretended):
        (uploads if isinstance(args[0], Pretended) else syncs)[name] += 1
    elif ours and (name in SYNCS or (indexed and _masked(args))):
        syncs[name] += 1
    if target is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    arguments = _each(args, _inner)
    card = there and Pretended.where == CUDA
    if card and name == CONVOLUTION and torch.backends.cudnn.conv.fp32_precision == "tf32" and args[-1] == 1:
        # Depthwise kernels multiply in float32.
        arguments = [*map(_tf32, arguments[:2]), *arguments[2:]]
    result = func(*arguments, **_each(kwargs, _inner))
    operator = name.split(".")[1]
    in_place = operator.startswith("__i") or (operator.endswith("_") and not operator.endswith("__"))
    if in_place and args and isinstance(args[0], torch.Tensor):
        if operator in RESHAPED and isinstance(args[0], Pretended):
            with torch._C._DisableTorchDispatch():
                func(*args, **kwargs)  # the wrapper's own shape
        return args[0]
    return _each(result, _wrapped) if there else result


def _each(x, change):
    """A tree of lists, tuples and dicts with its tensors changed."""
    if isinstance(x, torch.Tensor):
        return change(x)
    if isinstance(x, list | tuple):
        return type(x)([_each(part, change) for part in x])
    if isinstance(x, dict):
        return {key: _each(part, change) for key, part in x.items()}
    return x


def _inner(x: torch.Tensor) -> torch.Tensor:
    return x.inner if isinstance(x, Pretended) else x


def _tf32(x: torch.Tensor) -> torch.Tensor:
    """Rounded to 10 bits of mantissa, ties to even."""
    if x.dtype != torch.float32:
        return x
    bits = x.view(torch.int32)
    return (bits + 0xFFF + (bits >> 13 & 1) & ~0x1FFF).view(torch.float32)


def _wrapped(x: torch.Tensor) -> torch.Tensor:
    if x.dtype == torch.float64 and Pretended.where == MPS:
        raise TypeError(
            "Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64."
        )
    return x if isinstance(x, Pretended) else Pretended(x)


def _masked(args) -> bool:
    """Whether indices are found from a mask: CUDA waits for their number, unless one value is written to
    all.
    """
    mask = any(isinstance(x, torch.Tensor) and x.dtype in (torch.bool, torch.uint8) for x in args[1])
    return mask and (len(args) < 3 or args[2].dim() > 0)


class _Mode(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.syncs: Counter = Counter()
        self.uploads: Counter = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, self.syncs, self.uploads)


@contextlib.contextmanager
def pretend_cuda(memory: int = 1 << 34, *, mps: bool = False) -> Iterator[_Mode]:
    """Within it, `cuda:0` is a device of so many free bytes. Generators of it are the CPU's; inference mode
    is `no_grad`, which wrappers allow. With `mps` it is Apple's device instead, `mps:0`, which has no
    float64.
    """
    real = torch.Generator
    made = torch.tensor
    given = torch.as_tensor

    class Generator:
        def __new__(cls, device="cpu"):
            return real("cpu")

    def tensor(data, *, device=None, **kwargs):
        if device is None or torch.device(device).type == "cpu":
            return made(data, device=device, **kwargs)
        return made(data, **kwargs).to(device)

    def as_tensor(data, dtype=None, device=None):
        if isinstance(data, torch.Tensor) or device is None or torch.device(device).type == "cpu":
            return given(data, dtype=dtype, device=device)
        return given(data, dtype=dtype).to(device)

    def enter(mode):
        mode.before = torch.is_grad_enabled()
        torch.set_grad_enabled(mode.before and not mode.mode)

    def leave(mode, *error):
        torch.set_grad_enabled(mode.before)

    convert = torch.nn.Module._apply

    def apply(self, fn, recurse=True):
        # A module that is there already keeps its parameters, with their hooks, as on a card.
        pairs = ((x, fn(x)) for x in (*self.parameters(), *self.buffers()))
        unchanged = all((x.device, x.dtype) == (y.device, y.dtype) for x, y in pairs)
        return self if unchanged else convert(self, fn, recurse)

    replaced = {
        torch.nn.Module: {"_apply": apply},
        torch: {"Generator": Generator, "tensor": tensor, "as_tensor": as_tensor},
        torch.inference_mode: {"__enter__": enter, "__exit__": leave},
        torch.Tensor: {"pin_memory": lambda self, *a: self},
        torch.cuda: {
            "_lazy_init": lambda: None,
            "is_available": lambda: True,
            "device_count": lambda: 1,
            "current_device": lambda: 0,
            "mem_get_info": lambda device=None: (memory, memory),
            "synchronize": lambda device=None: None,
            "get_device_name": lambda device=None: "pretended",
            "is_bf16_supported": lambda including_emulation=True: True,
        },
        # Builds of torch for CUDA ask in each step of an optimiser whether it is recorded.
        torch.accelerator: {
            "current_stream": lambda device=None: SimpleNamespace(is_capturing=lambda: False)
        },
        torch.mps: {"recommended_max_memory": lambda: memory, "driver_allocated_memory": lambda: 0},
    }
    kept = {(owner, name): getattr(owner, name) for owner, names in replaced.items() for name in names}
    for owner, names in replaced.items():
        for name, value in names.items():
            setattr(owner, name, value)
    Pretended.where = MPS if mps else CUDA
    # Builds of torch for CUDA bring Triton, which would look for a driver.
    triton = sys.modules.get("triton", _ABSENT)
    sys.modules["triton"] = None
    _compiles.cache_clear()
    # Else `module.double()` changes the type of a wrapper and leaves what it wraps.
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    try:
        with _Mode() as mode:
            yield mode
    finally:
        Pretended.where = CUDA
        _compiles.cache_clear()
        del sys.modules["triton"]
        if triton is not _ABSENT:
            sys.modules["triton"] = triton
        torch.__future__.set_overwrite_module_params_on_conversion(False)
        for (owner, name), value in kept.items():
            setattr(owner, name, value)
