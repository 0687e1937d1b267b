"""Operations in their plain form, which kernels are measured against."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from fprf.ops import backend

P = ParamSpec("P")
T = TypeVar("T")


def plainly(function: Callable[P, T]) -> Callable[P, T]:
    """The function without kernels."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        with backend.plain():
            return function(*args, **kwargs)

    return call
