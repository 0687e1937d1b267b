"""Methods: functions that return a complete config. Each says only how it differs from the one it starts
from, and imports the configs of its own kind of scene alone.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .config import TrainConfig
    from .splats.config import GaussiansConfig


def fprf() -> "TrainConfig":
    """The paper's sizes: VGG-19 relu2_1 content, DINOv2 semantics, tri-planes 64 to 512, 256 + 128 + 48
    samples.

    As in the paper it learns from pixels alone. Where exposures differ, `--tones none` learns them; with few
    photographs, `--datamanager.depth-share 0.25` asks a quarter of the rays to end at sparse points, as
    `fprf-lite` does with its rays.
    """
    from .config import ContentConfig, RenderConfig, TrainConfig
    from .datamanagers.config import RayBatchesConfig
    from .plugins.decoders.config import MlpDecoderConfig

    return TrainConfig(
        content=ContentConfig(decoder=MlpDecoderConfig(objective="paper")),
        datamanager=RayBatchesConfig(depth_share=0.0),
        tones=False,
        render=RenderConfig(train_budget=0.0),
    )


def fprf_lite() -> "TrainConfig":
    """Bundled encoders, no download, made for a CPU."""
    from .config import ContentConfig, LossConfig, OptimizerConfig, SemanticConfig, TrainConfig
    from .datamanagers.config import RayBatchesConfig
    from .fields.config import PlanesConfig, SemanticPlanesConfig
    from .plugins.encoders.config import BundledContentConfig
    from .plugins.samplers.config import ProposalConfig

    planes = PlanesConfig(channels=16, hidden=64, layers=1)
    semantics = SemanticPlanesConfig(resolutions=(32, 128), channels=16, hidden=64, layers=1)
    return TrainConfig(
        steps=12_000,
        datamanager=RayBatchesConfig(rays=2048, semantic_share=0.25),
        sampler=ProposalConfig(samples=(48,), final=14, resolutions=(128,), anneal_steps=500),
        content=ContentConfig(encoder=BundledContentConfig(), field=planes, moves_density=False),
        semantic=SemanticConfig(field=semantics, dim=32, samples=2),
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


def fprf_splats() -> "GaussiansConfig":
    """3D Gaussians instead of fields, made for a CPU: seconds to minutes a scene; a file that `fprf restyle`
    takes.
    """
    from .splats.config import GaussiansConfig

    return GaussiansConfig()
