"""Runs of 3D Gaussians, opened from their folder alone (semantics, levels of detail, exposures, poses), and captures."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..config import RunConfig
from ..datamanagers.scene import Scene
from ..errors import CheckpointError, UsageError
from ..io.tensorfiles import load_sealed, save
from ..rendering.cameras import Cameras
from ..training import checkpoint
from ..training.camera_optimizers import Poses, Tones, moved_cameras
from ..training.driver import Schedule, learn
from ..training.loading import LoadedRun
from ..training.model import Facts, tones_of
from ..training.prepare import cache_folder, reach_of
from ..training.quality import PRESETS, QualityConfig, tone_of
from ..training.run import Run, in_training
from .config import GaussiansConfig, LookConfig
from .files import Capture
from .gaussians import from_tensors
from .learner import MOVES, GaussianLearner
from .levels import Levels, make_levels_of_detail, open_levels, write_levels
from .photographs import load_photographs, make_levels
from .scene import SplatScene, cache_name, load_scene, look_at_capture, run_scene, scene_tensors
from .semantics import Semantics, load_semantics, semantics_tensors

_FIT_RATE, _FIT_STEPS = 2e-3, 120
"""Rate of poses (`GaussiansConfig.poses`) and steps of each view, where poses of views are fitted to a finished scene."""
_CACHED = 24
"""Captures of which the cache keeps what was found out."""
_LEVELS, _MANY = "levels", 400_000
"""Folder of a run; Gaussians from which on levels of detail are kept there and mapped, not made in memory."""


def open_gaussians(run: Run, config: RunConfig, device: str, quality: QualityConfig) -> LoadedRun[SplatScene]:
    """A run of Gaussians; they are drawn on the CPU, whatever the device.

    Raises CheckpointError with what is missing, UsageError for qualities other than a resolution.
    """
    assert isinstance(config, GaussiansConfig)  # by its kind
    if quality.max_memory:
        raise UsageError("--max-memory: is for runs of fields; leave it out")
    root, preset = run.root, None if quality.quality is None else PRESETS[quality.quality]
    merged = None if preset is None else preset.merged
    # Levels of detail were written from what was verified.
    key = "" if merged is None else checkpoint.digest(run.checkpoints)
    saved, _ = checkpoint.load_latest(run.checkpoints, verify=not key or open_levels(root / _LEVELS, key) is None)
    if saved is None:
        raise CheckpointError(f"{root}: no checkpoint yet; go on with `fprf train {root / 'config.json'} --output {root}`")
    # The scene as training left it: its cameras where they were put, in the light that all views have in common.
    captured, gaussians = run.load_known(), from_tensors(saved.model)
    known = replace(captured, cameras=refined(captured.cameras, saved))
    tones = tones_of(known.facts)
    if tones is not None:
        kept = {name: saved.optimizer[f"tones.{name}.value"] for name, _ in tones.named_parameters()}
        tones.load_state_dict(kept, strict=False)
        tones.requires_grad_(False)
    near, training = float(saved.model.get("near", torch.tensor(0.01))), in_training(root)
    whole = run_scene(config, known, gaussians, near, quick=training)
    resolution = preset.resolution if preset is not None else 1.0

    def fit(scene: Scene, views: Sequence[int]) -> Annotated[Tensor, "V 6"]:
        return fit_poses(config, replace(scene, cameras=known.cameras), known.facts, whole, tones, views)

    def levels() -> Levels:
        """Levels of detail; those of many Gaussians lie in a file, written where there is none of this checkpoint."""
        if len(gaussians) < _MANY:
            return make_levels_of_detail(gaussians)
        if open_levels(root / _LEVELS, key) is None:
            write_levels(root / _LEVELS, gaussians, key)
        mapped = open_levels(root / _LEVELS, key)
        assert mapped is not None  # it was just written
        return mapped

    shown = replace(
        whole,
        # What a training has learnt so far is looked at quickly, and not kept.
        found=whole.found if training else functools.cache(lambda: _semantics(run, saved.step, whole, config)),
        resolution=resolution if quality.resolution is None else quality.resolution,
        tone=(1.0, 1.0, 1.0) if quality.tone is None else tone_of(tones, known, quality.tone),
        tones=tones,
        poses=fit,
        merged=merged,
        levels=functools.cache(levels),
    )
    return LoadedRun(run, run.load_config()[1], known, saved.step, saved.seconds, shown)


def refined(cameras: Cameras, saved: checkpoint.Saved) -> Cameras:
    """The cameras of all views where training put them."""
    moves = saved.optimizer.get(MOVES)
    return cameras if moves is None else moved_cameras(cameras, moves)


def fit_poses(
    config: GaussiansConfig, scene: Scene, facts: Facts, shown: SplatScene, tones: Tones | None, views: Sequence[int]
) -> Annotated[Tensor, "V 6"]:
    """Turns (radians) and shifts (world units), float64, that bring renders of some views nearest to their photographs.

    Gaussians stay as they are; the other views' moves are 0.
    """
    # These views are all that is learnt from; of the others nothing may move.
    scene = replace(scene, train=torch.tensor(views))
    images, masks, _ = load_photographs(config, scene, list(views))
    others = tuple(sorted(set(range(len(scene.paths))) - set(views)))
    poses = Poses(scene.cameras.pose[:, :, 3], others, reach=reach_of(scene, facts.space), pace=1.0, still=True)
    levels = make_levels(scene, images, masks, shown.near)
    # A learner of poses alone: the Gaussians are drawn as they are, in the light of each view.
    config = replace(config, poses=_FIT_RATE, degree=shown.gaussians.degree)
    learner = GaussianLearner(config, levels, 1.0, len(shown.gaussians), tones=tones, poses=poses, only="poses")
    learner.start_from(shown.gaussians)
    learn(learner, None, Schedule(_FIT_STEPS * len(views)), lambda report: None)
    return poses.moved_by()


def _semantics(run: Run, step: int, scene: SplatScene, config: GaussiansConfig) -> Semantics:
    """Semantics from the run folder; found anew and kept where those are of another step, encoder or setting."""
    wanted = {"step": step, "regions": config.regions, "semantic_size": config.semantic_size}
    if (run.root / "style.safetensors").is_file():
        tensors = run.load_tensors("style")
        if {name: int(tensors.pop(name, torch.tensor(-1))) for name in wanted} == wanted:
            kept = load_semantics(tensors, len(scene.gaussians))
            if kept.encoder == scene.encoder().identity:
                return kept
    semantics = scene.found()
    run.save_tensors("style", {**semantics_tensors(semantics), **{name: torch.tensor(of) for name, of in wanted.items()}})
    return semantics


def open_capture(
    capture: Capture,
    look: LookConfig,
    *,
    cache: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> SplatScene:
    """A capture as a scene: its Gaussians that can be drawn, with views and features from the cache.

    What points up is as `look` says, else as the file does. Where views and features are absent, views are found here, and
    features, which are then stored, when they are first asked for. `cache` is the folder; by default the user's own.
    """
    look = replace(look, up=look.up or capture.up)
    folder, encoder = cache or cache_folder() / "captures", look.semantic.encoder.build()
    path = folder / cache_name(capture.data, encoder.identity, look)
    gaussians = capture.gaussians.drawable()
    if path.is_file():
        try:
            scene = load_scene(load_sealed(path), gaussians, capture.antialiased, encoder)
        except CheckpointError as error:
            say(f"looking again: {error}")
        else:
            path.touch()
            return replace(scene, origin=capture.origin)
    scene = look_at_capture(gaussians, capture.antialiased, encoder, look, progress, capture.camera)

    def found() -> Semantics:
        semantics = scene.found()
        save(path, scene_tensors(scene), sealed=True)
        for old in sorted(folder.glob("*.safetensors"), key=lambda each: each.stat().st_mtime)[:-_CACHED]:
            old.unlink(missing_ok=True)
        return semantics

    return replace(scene, found=functools.cache(found), origin=capture.origin)
