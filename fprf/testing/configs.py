"""Contract of a plug-in's config, and the plug-in that it builds."""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import nn

from ..plugins.codec import from_json, to_json
from ..plugins.config import Need, PluginConfig
from .outputs import require

Kind = TypeVar("Kind")


def check_config(config: PluginConfig) -> None:
    """A frozen dataclass that its defaults build, that compares by value, and that JSON carries there and
    back.
    """
    kind = type(config)
    parameters = getattr(kind, "__dataclass_params__", None)
    require(
        parameters is not None and parameters.frozen,
        f"{kind.__name__}: must be a dataclass(frozen=True, kw_only=True)",
    )
    require(kind() == kind(), f"{kind.__name__}: two with the same values must be equal")
    require(from_json(to_json(config), kind) == config, f"{kind.__name__}: must survive JSON unchanged")
    for field in dataclasses.fields(kind):
        require(
            field.name not in ("type", "build", "needs"),
            f"{kind.__name__}: a field must not be called {field.name!r}",
        )
        require(field.kw_only is True, f"{kind.__name__}.{field.name}: fields must be keyword-only")
    require(
        all(type(need) is Need for need in config.needs()),
        f"{kind.__name__}: needs() must give Need, as often as it is asked",
    )


def built(
    config: PluginConfig, kind: type[Kind], build: Callable[[], object], *, again: bool = True
) -> tuple[Kind, str]:
    """The plug-in of a config that keeps to the rules of configs, and the name that sentences about it begin
    with.

    `again` builds it twice, to see that its parameters come from the seed.
    """
    check_config(config)
    made = build()
    name = type(config).__name__
    require(
        isinstance(made, kind),
        f"{name}: build() gives {type(made).__name__}, not an fprf.interfaces.{kind.__name__}",
    )
    assert isinstance(made, kind)
    module: object = made
    other = None
    if again and isinstance(module, nn.Module):
        other = build()
    if isinstance(module, nn.Module) and isinstance(other, nn.Module):
        mine = module.state_dict()
        theirs = other.state_dict()
        equal = mine.keys() == theirs.keys() and all(torch.equal(mine[key], theirs[key]) for key in mine)
        require(equal, f"{name}: its parameters must be drawn from the seed alone")
    return made, name
