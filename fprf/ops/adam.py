"""A step of Adam (Kingma and Ba 2015, Algorithm 1) on a large table, which also clears the gradient for the next.

`step_reference` is the plain form. On the CPU in float32 a compiled kernel takes one pass over memory, in the
place of one to clear the gradient and one to update.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

import math
from collections.abc import Iterable
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .backend import compiled_for
from .dense import array

MIN_EPS = 1e-30  # the kernel multiplies by reciprocals, which must be finite
_LANES = 16  # numbers of the widest vector
_LARGE = 2**19  # numbers from which a norm is worth a kernel


class AdamStep(NamedTuple):
    """Numbers of one step."""

    rate: float
    """Learning rate."""
    beta1: float
    """Decay of the mean of the gradient, in [0, 1)."""
    beta2: float
    """Decay of the mean of its square, in [0, 1)."""
    eps: float
    """Added to the root of the second."""
    taken: int
    """Steps that the means hold, this one included."""


class Moments(NamedTuple):
    """Means of a parameter's gradient and of its square, both from 0; changed in place."""

    first: Annotated[Tensor, "..."]
    second: Annotated[Tensor, "..."]


def usable(parameter: Tensor, gradient: Tensor, *, eps: float) -> bool:
    """Return whether the kernel applies: float32 on the CPU, contiguous, whole vectors, an eps whose reciprocal
    is finite.
    """
    whole = parameter.is_contiguous() and gradient.is_contiguous() and parameter.numel() % _LANES == 0
    return compiled_for(parameter, gradient) and whole and eps >= MIN_EPS


def step(parameter: Tensor, gradient: Tensor, moments: Moments, by: AdamStep) -> None:
    """Move a parameter and its moments, and set the gradient to 0, in place and without a graph.

    Where `usable`. With u = 2^-24, the first moment m errs by 3u (beta1 |m| + (1 - beta1) |g|), the second by
    4u of itself, the parameter by 2u of itself and 16u of a step of such a first moment.
    """
    from . import adam_kernels as kernels

    decays = (by.beta1, 1 - by.beta1, by.beta2, 1 - by.beta2)
    factors = (by.rate / (1 - by.beta1**by.taken), (1 - by.beta2**by.taken) ** -0.5, by.eps)
    numbers = np.array((*decays, *factors), np.float32)
    kernels.step(array(parameter), array(gradient), array(moments.first), array(moments.second), numbers)


@torch.no_grad()
def step_reference(parameter: Tensor, gradient: Tensor, moments: Moments, by: AdamStep) -> None:
    """The plain form, on any device and in any dtype."""
    moments.first.lerp_(gradient, 1 - by.beta1)
    moments.second.mul_(by.beta2).addcmul_(gradient, gradient, value=1 - by.beta2)
    # Both means began at 0: divided by the sum of their weights they have no bias.
    root = (moments.second / (1 - by.beta2**by.taken)).sqrt()
    parameter.sub_(by.rate / (1 - by.beta1**by.taken) * moments.first / (root + by.eps))
    gradient.zero_()


def gradient_norm(parameters: Iterable[Tensor]) -> Tensor:
    """Euclidean norm of all gradients, a scalar; not finite where one isn't, or where it is above 1.8e19."""
    small = []
    squares = []
    for parameter in parameters:
        grad = parameter.grad
        if grad is None:
            continue
        if grad.numel() >= _LARGE and compiled_for(grad) and grad.is_contiguous():
            from . import adam_kernels as kernels

            squares.append(kernels.square_sum(array(grad)))
        else:
            small.append(grad)
    norm = torch.nn.utils.get_total_norm(small)
    if not squares:  # as elsewhere than on the CPU, where there may be no float64
        return norm
    whole: Tensor = norm.double().square() + math.fsum(squares)
    return whole.sqrt().to(norm.dtype)
