"""Tasks on many processes or machines, by Ray Core. A task whose worker dies is started again and finds its
own checkpoint.

A cluster whose address is given is joined; without one a private one is started on this machine: on the
loopback, with a token of its own, without dashboard and without telling anybody that it is used.
"""

import importlib
import os
import secrets
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from ...errors import PluginError
from ...interfaces import Executor
from ...memory import keep_memory
from .config import RayConfig

Task = TypeVar("Task")
Result = TypeVar("Result")


class SerialExecutor(Executor):
    """The default: no dependency, no processes."""

    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """Results in the order of the tasks; the first error stops the rest."""
        found: list[Result] = []
        for task in tasks:
            found.append(function(task))
        return found


def resources(config: RayConfig) -> dict[str, float]:
    """Options of `ray.remote` for each task."""
    return {"num_cpus": config.processors, "num_gpus": config.gpus or 0.0, "max_retries": config.retries}


class RayExecutor(Executor):
    """One Ray task a task, in the order that they are given."""

    def __init__(self, config: RayConfig) -> None:
        self.config = config

    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """Results in the order of the tasks; the first error cancels the rest and reaches the caller as it
        was raised.

        Raises PluginError where Ray is not installed, its cluster cannot be reached, or has fewer GPUs than a
        task takes.
        """
        ray = _ray(private=not self.config.address)
        self._join(ray)
        wanted = self.config.gpus or 0.0
        there = float(ray.cluster_resources().get("GPU", 0.0))
        if wanted > there:  # Ray would wait for a machine that has them
            raise PluginError(
                f"executor: each task takes {wanted:g} GPUs and the cluster has {there:g}; start Ray on machines with GPUs, or "
                "train with --device cpu --executor.gpus 0"
            )

        def work(task: Task) -> Result:  # Ray takes functions alone, and not every callable is one
            keep_memory()
            return function(task)

        # All at once; Ray starts as many as have room.
        remote = ray.remote(**resources(self.config))(work)
        waiting = [remote.remote(task) for task in tasks]
        try:
            found: list[Result] = []
            for reference in waiting:
                found.append(ray.get(reference))
            return found
        except BaseException as error:
            # Ray aborts this process if it cancels a task whose completion it is just taking in
            # (ray-project/ray#54798).
            for reference in ray.wait(waiting, num_returns=len(waiting), timeout=0)[1]:
                ray.cancel(reference)
            # What a task raised reaches the caller as it was raised; what Ray says is told in one line.
            if isinstance(error, ray.exceptions.RayTaskError) and isinstance(error.cause, Exception):
                raise error.cause from None
            if isinstance(error, ray.exceptions.RayError):
                raise PluginError(
                    f"executor: a task's worker died {self.config.retries + 1} times ({type(error).__name__}); look at the "
                    "memory of the machine, then run the same command again: finished blocks are kept"
                ) from error
            raise

    def _join(self, ray: Any) -> None:
        if ray.is_initialized():
            return
        # A cluster that is named, else one of this machine alone.
        common = {"logging_level": "warning", "log_to_driver": True}
        try:
            if self.config.address:
                ray.init(address=self.config.address, **common)
                return
            count = self.config.workers * self.config.processors
            # Without "local" Ray would look for any cluster that runs, or ran, on this machine.
            ray.init(address="local", num_cpus=count, include_dashboard=False, **common)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            where = self.config.address or "this machine"
            raise PluginError(
                f"executor: no Ray cluster at {where} ({error}); docs/large-scenes.md says how to start one"
            ) from error


def _ray(*, private: bool) -> Any:
    """The module; it reads the environment when it is imported, so what it shall know is said before."""
    # Nobody is told that it runs; a cluster of our own listens on the loopback, behind a token.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if private:
        # No cluster means the loopback, on Linux too; an address of it given to `init` is replaced by one for
        # others.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    if private and not {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys():
        os.environ.setdefault("RAY_AUTH_MODE", "token")
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        remedy = '`pip install "fprf[cluster]"`, or choose --executor serial'
        raise PluginError(f"executor: Ray is not installed; {remedy}") from error
