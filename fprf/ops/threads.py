"""Cache and threads of compiled kernels.

Numba caches what it compiled under the text of a kernel's own file, but constants and traced functions of
other files are compiled into it: after an update it would go on with the former ones. Here the text of all
that kernels are made of counts: the files of `fprf/ops` without torch.

Numba's own threads cost half of the compilation, and split work evenly, which pixels and Gaussians are not:
here threads take what is to be done one by one.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg"

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.extending import intrinsic

from ..io.cache import cache_home, reason_of, refusal, say_uncached, user_folder


@cache
def sources(folder: Path = Path(__file__).parent) -> str:
    """Hash of the text that kernels are compiled from."""
    texts = (file.read_bytes() for file in sorted(folder.rglob("*.py")))
    return hashlib.sha256(b"".join(text for text in texts if b"\nimport torch" not in text)).hexdigest()


_AT_HOME = "UserWideCacheLocator"
"""Ending of the name of numba's class for a folder in the home; releases differ in an underscore before it."""


class _KernelFiles(CompileResultCacheImpl):
    """Numba's choice of a folder, but none in the home of a user who has no home: the folder would be named
    ~, in the working directory.
    """

    def __init__(self, function):
        if cache_home() is None:
            found = CompileResultCacheImpl._locator_classes
            self._locator_classes = [each for each in found if not each.__name__.endswith(_AT_HOME)]
        super().__init__(function)


class _KernelCache(FunctionCache):
    """Numba's files of what it compiled; whatever the system or a damaged file refuses, kernels are compiled
    in memory.
    """

    _impl_class = _KernelFiles

    def load_overload(self, sig, target_context):
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a file that is damaged or closed to us: unpickling raises whatever its bytes say
            self._forget()
            return None

    def save_overload(self, sig, data):
        try:
            super().save_overload(sig, data)
        except OSError as error:
            self.disable()
            # Its index was written before the code: it would lead to that of another version.
            self._forget()
            say_uncached(Path(self.cache_path), reason_of(error))

    def _forget(self):
        with suppress(OSError):
            Path(self._cache_file._index_path).unlink()


def cached_jit(**options: Any) -> Callable[[Any], Any]:
    """`numba.njit` with these options and a cache; numba looks for what it compiled by variables that a
    function encloses.

    Without a folder that can be written to it compiles in memory, which one line says.
    """

    def compiled(function: Any) -> Any:
        code = function.__code__
        enclosed = function.__closure__ or ()
        code = code.replace(co_freevars=(*code.co_freevars, "sources"))
        dated = FunctionType(
            code,
            function.__globals__,
            function.__name__,
            function.__defaults__,
            (*enclosed, CellType(sources())),
        )
        dated.__module__ = function.__module__
        dated.__qualname__ = function.__qualname__
        dated.__doc__ = function.__doc__
        kernel = numba.njit(**options)(dated)
        try:
            kernel._cache = _KernelCache(dated)
        except RuntimeError:  # numba found no folder
            folder = user_folder("")
            say_uncached(folder, refusal(folder))
        return kernel

    return compiled


@intrinsic
def take(typing, counters, k):
    """counters[k] before 1 is added to it, as one step for all threads."""

    def generate(context, build, sig, args):
        data = context.make_array(sig.args[0])(context, build, args[0]).data
        place = build.gep(data, [context.cast(build, args[1], sig.args[1], types.intp)])
        return build.atomic_rmw("add", place, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counters, k), generate


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="fprf-ops")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


def on_threads(kernel: Callable[..., Any], *args: Any) -> list[Any]:
    """kernel(counters, *args) on each of `numba.get_num_threads()` threads; what each returned.

    `counters` are two zeros (int64) for `take`: the first for what is to be done, the second for the number
    of a thread.
    """
    counters = np.zeros(2, np.int64)
    others = numba.get_num_threads() - 1
    if others == 0:
        return [kernel(counters, *args)]
    running = [_pool(others).submit(kernel, counters, *args) for _ in range(others)]
    return [kernel(counters, *args), *(each.result() for each in running)]
