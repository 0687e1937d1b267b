"""Packages for the plug-in tests: real files and real metadata on sys.path, as pip would leave them."""

import contextlib
import importlib
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from fprf.plugins import registry


class Packages:
    def __init__(self, root: Path) -> None:
        self.root = root

    def install(
        self,
        name: str,
        points: Mapping[str, Mapping[str, str]],
        *,
        code: Mapping[str, str] | None = None,
        version: str = "1",
    ) -> None:
        """Modules by name, and entry points by group."""
        text = "".join(
            f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in named.items())
            for group, named in points.items()
        )
        self.raw(name, text, version)
        for module, source in (code or {}).items():
            (self.root / f"{module}.py").write_text(source)
        importlib.invalidate_caches()

    def raw(self, name: str, entry_points: str, version: str = "1") -> None:
        folder = self.root / f"{name.replace('-', '_')}-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        (folder / "entry_points.txt").write_text(entry_points)
        importlib.invalidate_caches()
        registry.forget()


@contextlib.contextmanager
def packages_in(root: Path) -> Iterator[Packages]:
    modules = set(sys.modules)
    root.mkdir(exist_ok=True)
    sys.path.insert(0, str(root))
    importlib.invalidate_caches()
    registry.forget()
    try:
        yield Packages(root)
    finally:
        sys.path.remove(str(root))
        for name in set(sys.modules) - modules:
            if str(root) in (getattr(sys.modules[name], "__file__", None) or ""):
                del sys.modules[name]
        importlib.invalidate_caches()
        registry.forget()


ENCODER = '''
from dataclasses import dataclass
from fprf.plugins.encoders.config import EncoderConfig

@dataclass(frozen=True, kw_only=True)
class {name}Config(EncoderConfig):
    """A stranger's encoder."""

    tile: int = 224
    """Tile in pixels."""
    scales: tuple[float, ...] = (0.25, 0.5)
    """Scales."""

    def build(self):
        raise NotImplementedError
'''

METHOD = '''
from dataclasses import dataclass
from fprf.checks import at_least
from fprf.config import TrainConfig
from fprf.plugins.encoders.config import EncoderConfig, RandomConfig

@dataclass(frozen=True, kw_only=True)
class AcmeConfig(TrainConfig):
    """A stranger's method with fields of its own."""

    knob: int = 1
    """A number."""
    shares: tuple[float, ...] = (0.5,)
    """Shares."""
    teacher: EncoderConfig | None = RandomConfig()
    """A slot."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("knob", self.knob, 0)

def acme() -> AcmeConfig:
    """A stranger's method."""
    return AcmeConfig(knob=2)
'''
