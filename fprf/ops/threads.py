"""Compiled kernels on several threads, without numba's own ones: these cost half of the compilation and split work evenly,
which pixels and Gaussians are not."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numba
import numpy as np


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="fprf-ops")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


def on_threads(kernel: Callable[..., Any], *args: Any) -> list[Any]:
    """kernel(counters, *args) on each of `numba.get_num_threads()` threads; what each returned.

    `counters` are two zeros (int64) for `simd.take`: threads take what is to be done one by one, and numbers for themselves.
    """
    counters, others = np.zeros(2, np.int64), numba.get_num_threads() - 1
    if others == 0:
        return [kernel(counters, *args)]
    running = [_pool(others).submit(kernel, counters, *args) for _ in range(others)]
    return [kernel(counters, *args), *(each.result() for each in running)]
