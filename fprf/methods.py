"""Methods: functions that return a complete config. Each says only how it differs from the one it starts
from.

`config.json` holds a config with its method, the version that wrote it and the packages of its plug-ins.
Duplicate keys, NaN, unknown keys and foreign formats are refused. A file is read as the class of config that
its method returns, so a method whose config has fields of its own must be installed.
"""

import json
from importlib.metadata import version
from pathlib import Path

import msgspec

from .config import (
    ContentConfig,
    LossConfig,
    OptimizerConfig,
    RenderConfig,
    RunConfig,
    SemanticConfig,
    TrainConfig,
)
from .datamanagers.config import RayBatchesConfig
from .errors import ConfigError, FprfError, PluginError
from .fields.config import PlanesConfig, SemanticPlanesConfig
from .io.atomic import write_text
from .plugins import registry
from .plugins.codec import from_json, packages_of, read_json, to_json
from .plugins.decoders.config import MlpDecoderConfig
from .plugins.encoders.config import BundledContentConfig
from .plugins.samplers.config import ProposalConfig
from .splats.config import GaussiansConfig

_METHODS = "fprf.methods"
_FORMAT = 1
_VERSION = version("fprf")


class _ConfigFile(msgspec.Struct, forbid_unknown_fields=True):
    """Content of config.json."""

    format: int
    fprf: str
    """Version that wrote it."""
    method: str
    plugins: dict[str, str]
    """Name, package and version of what fills each slot."""
    config: object


def fprf() -> TrainConfig:
    """The paper's sizes: VGG-19 relu2_1 content, DINOv2 semantics, tri-planes 64 to 512, 256 + 128 + 48
    samples.

    As in the paper it learns from pixels alone. Where exposures differ, `--tones none` learns them; with few
    photographs, `--datamanager.depth-share 0.25` asks a quarter of the rays to end at sparse points, as
    `fprf-lite` does with its rays.
    """
    content = ContentConfig(decoder=MlpDecoderConfig(objective="paper"))
    manager = RayBatchesConfig(depth_share=0.0)
    return TrainConfig(
        content=content, datamanager=manager, tones=False, render=RenderConfig(train_budget=0.0)
    )


def fprf_lite() -> TrainConfig:
    """Bundled encoders, no download, made for a CPU."""
    return TrainConfig(
        steps=12_000,
        datamanager=RayBatchesConfig(rays=2048, semantic_share=0.25),
        sampler=ProposalConfig(samples=(48,), final=14, resolutions=(128,), anneal_steps=500),
        content=ContentConfig(encoder=BundledContentConfig(), field=_LITE_PLANES, moves_density=False),
        semantic=SemanticConfig(field=_LEAN_SEMANTICS, dim=32, samples=2),
        # At twice this rate fox diverged after 450 steps (24.8 -> 17.7 dB); it must fall with the steps, not
        # the minutes.
        optimizer=OptimizerConfig(rate=1e-2, final=0.05, warm_up=100, hold=500),
        # Strong smoothing: few rays and steps must not leave floaters before cameras (fox, one minute: 21.5
        # -> 27.1 dB). With more of it, or planes that end at 256, pictures stay blurred however long one
        # trains (fox: 27 -> 29.7 dB).
        loss=LossConfig(
            content=3e-3, variation=5e-4, proposal_variation=1e-3, distortion=1e-2, penalty_every=8
        ),
    )


def fprf_splats() -> GaussiansConfig:
    """3D Gaussians instead of fields, made for a CPU: seconds to minutes a scene; a file that `fprf restyle`
    takes.
    """
    return GaussiansConfig()


_LEAN_SEMANTICS = SemanticPlanesConfig(resolutions=(32, 128), channels=16, hidden=64, layers=1)
_LITE_PLANES = PlanesConfig(channels=16, hidden=64, layers=1)


def save_config(path: Path, config: RunConfig, method: str) -> None:
    """Write the config, synced and then renamed into place, so that a reader finds the old file or the new
    one.

    Raises ConfigError where the config has fields of its own and `method` would not give them back.
    """
    packages = packages_of(config)
    if type(config) is not TrainConfig:
        if type(method_config(method)) is not type(config):
            raise ConfigError(
                f"method {method!r} gives no {type(config).__name__}, so its fields could not be read again"
            )
        packages["method"] = registry.entry(_METHODS, method).package
    whole = {
        "format": _FORMAT,
        "fprf": _VERSION,
        "method": method,
        "plugins": packages,
        "config": to_json(config),
    }
    write_text(path, json.dumps(whole, indent=1, allow_nan=False) + "\n")


def load_config(path: Path) -> tuple[RunConfig, str]:
    """The config of a file and the name of its method.

    Raises ConfigError naming the file and the field, PluginError where the method is needed and not
    installed.
    """
    whole = read_json(path)
    try:
        # The format first: what another one holds is not ours to judge.
        if not isinstance(whole, dict) or "format" not in whole:
            raise ConfigError('expected an object with "format": 1, as `fprf train` writes it')
        if whole["format"] != _FORMAT or type(whole["format"]) is not int:
            raise ConfigError(
                f"is of format {whole['format']!r}, written by fprf {whole.get('fprf', '(unknown)')}; "
                f"fprf {_VERSION} reads format {_FORMAT}: use the version that wrote it"
            )
        file = msgspec.convert(whole, _ConfigFile)
        try:
            kind = type(method_config(file.method))
        except PluginError as fault:  # not installed, or broken
            # Only a method whose package is on record had fields of its own.
            if "method" in file.plugins:
                raise PluginError(f"{path}: {fault}; install {file.plugins['method']}") from fault
            kind = TrainConfig
        return from_json(file.config, kind, packages=file.plugins), file.method
    except msgspec.ValidationError as fault:
        raise ConfigError(f"{path}: {fault}; the file is damaged or was edited") from fault
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault


def method_config(name: str) -> RunConfig:
    """The config that an installed method returns. Raises PluginError naming the method and its package."""
    method = registry.load_object(_METHODS, name)
    origin = registry.entry(_METHODS, name).origin
    try:
        config = method() if callable(method) else method
    except FprfError as fault:
        raise PluginError(f"{_METHODS}: {name!r} ({origin}): {fault}") from fault
    except (Exception, SystemExit) as fault:  # a stranger's function
        raise PluginError(
            f"{_METHODS}: {name!r} ({origin}) failed: {type(fault).__name__}: {fault}"
        ) from fault
    if not isinstance(config, RunConfig):
        raise PluginError(f"{_METHODS}: {name!r} ({origin}) gives {type(config).__name__}, not a RunConfig")
    return config
