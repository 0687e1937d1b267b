"""The Ray executor; all but the refusals need Ray (extra `cluster`) and seconds to start it, once for all of
them.
"""

import importlib.util
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fprf.errors import PluginError
from fprf.plugins.executors.config import RayConfig
from fprf.plugins.executors.executors import resources
from fprf.testing import check_executor


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(PluginError, match=r'pip install "fprf\[cluster\]"'):
        RayConfig().build().map(abs, [1])


class Refusing:
    """Ray as far as joining goes; it keeps what it was asked for."""

    class exceptions:
        RayError = RayTaskError = KeyError

    def __init__(self) -> None:
        self.asked: dict[str, object] = {}

    def is_initialized(self) -> bool:
        return False

    def init(self, **asked: object) -> None:
        self.asked = asked
        raise ConnectionError("nobody there")


@pytest.mark.parametrize(("address", "joined"), [("", "local"), ("mars:7777", "mars:7777")])
def test_only_a_cluster_that_is_named_is_joined(
    monkeypatch: pytest.MonkeyPatch, address: str, joined: str
) -> None:
    ray = Refusing()
    monkeypatch.setitem(sys.modules, "ray", ray)
    for name in (
        "RAY_AUTH_MODE",
        "RAY_AUTH_TOKEN",
        "RAY_USAGE_STATS_ENABLED",
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER",
    ):
        monkeypatch.setenv(name, "set before")
    with pytest.raises(PluginError, match="nobody there"):
        RayConfig(address=address).build().map(abs, [1])
    assert ray.asked["address"] == joined


@pytest.mark.parametrize(
    ("gpus", "device", "asked"),
    [(None, "cuda", 1.0), (None, "cpu", 0.0), (None, "mps", 0.0), (0.25, "cuda", 0.25), (1.0, "cpu", 1.0)],
)
def test_tasks_on_cuda_ask_for_a_gpu(gpus: float | None, device: str, asked: float) -> None:
    config = RayConfig(gpus=gpus, processors=0.5, retries=2).on(device)
    assert resources(config) == {"num_cpus": 0.5, "num_gpus": asked, "max_retries": 2}
    assert config.on("cpu") == config, "what was chosen stays"


def test_a_cluster_without_gpus_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Poor(Refusing):
        def init(self, **asked: object) -> None:
            pass

        def cluster_resources(self) -> dict[str, float]:
            return {"CPU": 8.0}

    monkeypatch.setitem(sys.modules, "ray", Poor())
    with pytest.raises(
        PluginError, match="each task takes 1 GPUs and the cluster has 0; start Ray on machines with GPUs"
    ):
        RayConfig().on("cuda").build().map(abs, [1])


@pytest.fixture(scope="module")
def executor() -> Iterator[RayConfig]:
    if importlib.util.find_spec("ray") is None:  # not imported here: it reads its environment when it is
        pytest.skip("Ray is not installed")
    yield RayConfig(workers=2, processors=0.5)
    sys.modules["ray"].shutdown()


def listening() -> set[str]:
    """Addresses and ports that something on this machine listens on, in the kernel's spelling."""
    tables = [table for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")) if table.is_file()]
    rows = [row.split() for table in tables for row in table.read_text().splitlines()[1:]]
    return {row[1] for row in rows if row[3] == "0A"}


@pytest.mark.filterwarnings("ignore")
def test_the_contract(executor: RayConfig) -> None:
    before = listening()
    check_executor(executor)
    new = {port.partition(":")[0] for port in listening() - before}
    assert all(address.endswith("7F") for address in new), "127.0.0.1, whose bytes are written backwards"
    assert new or not Path("/proc/net/tcp").exists()
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert os.environ["RAY_AUTH_MODE"] == "token" and len(os.environ["RAY_AUTH_TOKEN"]) == 64


@pytest.mark.filterwarnings("ignore")
def test_tasks_run_elsewhere_and_a_killed_worker_is_started_again(
    executor: RayConfig, tmp_path: Path
) -> None:
    def once_killed(name: str) -> int:
        mark = tmp_path / name
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    found = executor.build().map(once_killed, ["a", "b"])
    assert os.getpid() not in found and len(found) == 2
