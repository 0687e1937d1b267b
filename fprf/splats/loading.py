"""Runs of 3D Gaussians, opened from their folder alone: semantics, levels of detail, exposures, poses."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError, UsageError
from ..run_config import RunConfig
from ..training import checkpoint
from ..training.camera_optimizers import Poses, Tones, tones_of
from ..training.driver import Schedule, learn
from ..training.facts import Facts
from ..training.loading import LoadedRun
from ..training.locks import in_training
from ..training.prepare import device_of, reach_of
from ..training.quality import PRESETS, QualityConfig, tone_of
from ..training.run import Run
from .config import GaussiansConfig
from .gaussians import Gaussians, from_tensors
from .learner import Bounds, GaussianLearner, Stage, refined
from .levels import Levels, make_levels_of_detail, open_levels, write_levels
from .photographs import load_photographs, make_levels
from .scene import SplatScene, with_illumination
from .semantics import SEMANTICS_VERSION, Semantics, find_semantics, load_semantics, semantics_tensors
from .view_corrections import ViewCorrections

_FIT_POSES_RATE = 2e-3
"""Rate (`GaussiansConfig.poses`) at which poses of views are fitted to a finished scene: what suits poses that
are off by some pixels (poses.json).
"""
_FIT_STEPS_PER_VIEW = 120
"""Steps of each view in fitting its pose; by eye: at its rate a pose moves by 0.1 in so many."""
_MAX_SEMANTIC_VIEWS = 32
"""Training views that semantics are found in, at most; by eye, as `LookConfig.views`."""
_FOLLOWED_SHARE = 4
"""Of a scene in training semantics are found in so many times fewer views, so that looks follow it; by eye."""
_MAX_SEMANTIC_ENLARGEMENT = 2.0
"""Times that small photographs are enlarged at most, so that the encoder sees things as large as in others:
from 160 pixels to 240, pixels at the borders of things match right on 3 in 100 more; more shows nothing but
blur.
"""
_LEVELS_FOLDER = "levels"
"""Folder of a run that holds its levels of detail."""
_MIN_MAPPED_GAUSSIANS = 400_000
"""Gaussians from which on levels of detail are kept there and mapped, not made in memory; by eye."""


def open_gaussians(run: Run, config: RunConfig, device: str, quality: QualityConfig) -> LoadedRun[SplatScene]:
    """A run of Gaussians; on a CUDA device views are drawn where gsplat can, all else is on the CPU.

    Raises CheckpointError with what is missing, UsageError for qualities other than a resolution.
    """
    assert isinstance(config, GaussiansConfig)  # by its kind
    if quality.max_memory:
        raise UsageError("--max-memory: is for runs of fields; leave it out")
    root = run.root
    preset = None
    if quality.quality is not None:
        preset = PRESETS[quality.quality]
    merged = None if preset is None else preset.merged
    # Levels of detail were written from what was verified.
    if merged is None:
        key = ""
    else:
        key = checkpoint.digest(run.checkpoints)
    saved, _ = checkpoint.load_latest(
        run.checkpoints, verify=not key or open_levels(root / _LEVELS_FOLDER, key) is None
    )
    if saved is None:
        raise CheckpointError(
            f"{root}: no checkpoint yet; go on with `fprf train {root / 'config.json'} --output {root}`"
        )
    # The scene as training left it: its cameras where they were put, in the light that all views have in
    # common.
    captured = run.load_known()
    gaussians = from_tensors(saved.model)
    known = replace(captured, cameras=refined(captured.cameras, captured.train, captured.facts, saved))
    tones = tones_of(known.facts)
    if tones is not None:
        kept = {name: saved.optimizer[f"tones.{name}.value"] for name, _ in tones.named_parameters()}
        tones.load_state_dict(kept, strict=False)
        tones.requires_grad_(False)
    near = float(saved.model.get("near", torch.tensor(0.01)))
    training = in_training(root)
    # What a training has learnt so far is looked at quickly, in few, small views, and not kept.
    if training:
        count = _MAX_SEMANTIC_VIEWS // _FOLLOWED_SHARE
        side = config.semantic_size // 2
    else:
        count = _MAX_SEMANTIC_VIEWS
        side = config.semantic_size
    reduction = max(1 / _MAX_SEMANTIC_ENLARGEMENT, float(known.cameras.size.amax()) / side)
    encoder = functools.cache(config.semantic.encoder.build)

    def found() -> Semantics:
        """Semantics from the run folder; found anew, and kept, where those are of another step, encoder or
        setting.
        """
        wanted = {
            "step": saved.step,
            "regions": config.regions,
            "semantic_size": config.semantic_size,
            "version": SEMANTICS_VERSION,
        }
        if not training and (root / "style.safetensors").is_file():
            tensors = run.load_tensors("style")
            if {name: int(tensors.pop(name, torch.tensor(-1))) for name in wanted} == wanted:
                kept = load_semantics(tensors, len(gaussians))
                if kept.encoder == encoder().identity:
                    return kept
        every = torch.tensor(known.train)
        views = known.cameras.select(
            every[torch.linspace(0, len(every) - 1, min(count, len(every))).round().long()]
        )
        views = views.scaled(reduction)
        semantics = find_semantics(gaussians, True, encoder(), views, config.regions, near=near)
        if not training:
            marks = {}
            for name, of in wanted.items():
                marks[name] = torch.tensor(of)
            run.save_tensors("style", {**semantics_tensors(semantics), **marks})
        return semantics

    resolution = preset.resolution if preset is not None else 1.0

    def fit(scene: ParsedScene, views: Sequence[int]) -> Annotated[Tensor, "V 6"]:
        return fit_poses(
            config, replace(scene, cameras=known.cameras), known.facts, gaussians, near, tones, views
        )

    def levels() -> Levels:
        """Levels of detail; those of many Gaussians lie in a file, written where there is none of this
        checkpoint.
        """
        if len(gaussians) < _MIN_MAPPED_GAUSSIANS:
            return make_levels_of_detail(gaussians)
        if open_levels(root / _LEVELS_FOLDER, key) is None:
            write_levels(root / _LEVELS_FOLDER, gaussians, key)
        mapped = open_levels(root / _LEVELS_FOLDER, key)
        assert mapped is not None  # it was just written
        return mapped

    shown = SplatScene(
        gaussians,
        antialiased=True,
        views=known.cameras,
        view_names=known.names,
        found=functools.cache(found),
        encoder=encoder,
        longest=round(int(known.cameras.size.amax()) / reduction),
        near=near,
        background=config.background,
        origin=known.facts.origin,
        up=known.facts.up,
        north=known.facts.north,
        resolution=resolution if quality.resolution is None else quality.resolution,
        tone=(1.0, 1.0, 1.0) if quality.tone is None else tone_of(tones, known, quality.tone),
        tones=tones,
        poses=fit,
        merged=merged,
        levels=functools.cache(levels),
        asked=device_of(device),
    )
    return LoadedRun(run, run.load_config()[1], known, saved.step, saved.seconds, with_illumination(shown))


def fit_poses(
    config: GaussiansConfig,
    scene: ParsedScene,
    facts: Facts,
    gaussians: Gaussians,
    near: float,
    tones: Tones | None,
    views: Sequence[int],
) -> Annotated[Tensor, "V 6"]:
    """Turns (radians) and shifts (world units), float64, that bring renders of some views nearest to their
    photographs.

    Gaussians stay as they are; the other views' moves are 0.
    """
    # These views are all that is learnt from; of the others nothing may move.
    scene = replace(scene, train=torch.tensor(views))
    images, masks, _ = load_photographs(config, scene, list(views))
    others = tuple(sorted(set(range(len(scene.paths))) - set(views)))
    poses = Poses(
        scene.cameras.pose[:, :, 3], others, reach=reach_of(scene, facts.space), pace=1.0, still=True
    )
    levels = make_levels(scene, images, masks, near)
    # A learner of poses alone: the Gaussians are drawn as they are, in the light of each view.
    config = replace(config, poses=_FIT_POSES_RATE, degree=gaussians.degree)
    learner = GaussianLearner(
        config,
        levels,
        Bounds(room=len(gaussians), scene_scale=1.0),
        corrections=ViewCorrections(tones, poses),
        stage=Stage(only="poses"),
    )
    learner.start_from(gaussians)
    learn(learner, None, Schedule(_FIT_STEPS_PER_VIEW * len(views)), lambda report: None)
    return poses.moved_by()
