"""`fprf cluster`: how blocks are trained on many machines. Nothing is started; the steps are printed for copying."""

from dataclasses import dataclass

from ..checks import between
from .parsing import parse


@dataclass(frozen=True, kw_only=True)
class ClusterConfig:
    """Addresses and limits of the printed lines."""

    head: str = "HEAD"
    """Address of the first machine, as the others reach it."""
    port: int = 6379
    """Port that it listens on."""

    def __post_init__(self) -> None:
        between("port", self.port, 1024, 65535)


_STEPS = """\
Blocks are trained as Ray tasks. On one machine nothing needs to be started:

  fprf train METHOD --data SCENE --blocks grid --executor ray --executor.workers 4

On many machines:

  1. on every machine          pip install "fprf[cluster]"
  2. one folder for all        SCENE, the run folder and XDG_CACHE_HOME lie on storage that every machine mounts alike
                               with `--device cuda` (or auto on a machine with a GPU) each task takes one GPU: --executor.gpus
  3. on {head:<22}         export RAY_USAGE_STATS_ENABLED=0 RAY_AUTH_MODE=token
                               ray get-auth-token --generate
                               ray start --head --port {port}
  4. on every other            the file ~/.ray/auth_token of {head}, readable by you alone, then
                               export RAY_USAGE_STATS_ENABLED=0 RAY_AUTH_MODE=token
                               ray start --address {head}:{port}
  5. on {head:<22}         fprf train METHOD --data SCENE --output RUN --blocks grid --executor ray --executor.address auto

Who holds the token may run anything on the machines: keep it, and keep the ports inside your network. A worker that is killed
or a machine that is lost costs the time since its last checkpoint (--checkpoint-minutes). `ray stop` ends it on each machine.
"""


def run(args: list[str]) -> int:
    """Print the steps."""
    config = parse(ClusterConfig(), args, prog="fprf cluster", description="How to train blocks on many machines.")
    print(_STEPS.format(head=config.head, port=config.port), end="")
    return 0
