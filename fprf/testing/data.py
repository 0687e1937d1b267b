"""Contracts of parsers of scene folders, data managers and files of Gaussians."""

# A plug-in is asked whether it is of an abstract kind.
# mypy: disable-error-code="type-abstract"

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from ..datamanagers.config import DataManagerConfig, FeatureTargets, TrainingPixels
from ..datamanagers.parsers.config import DataParserConfig
from ..errors import DataError
from ..interfaces import DataManager, DataParser
from ..ops.harmonics import HARMONIC
from ..plugins.encoders.config import RandomConfig
from . import cases
from .configs import built, check_config
from .outputs import close, require, same, tensor

if TYPE_CHECKING:
    from ..splats.files.base import CaptureFormat


def check_parser(config: DataParserConfig, data: Path) -> None:
    """A scene of `data`, a folder of that format: rigid poses, cameras that fit the paths, disjoint
    splits.
    """
    parser, name = built(config, DataParser, config.build)
    scene, *smaller = (parser.parse(data, downscale) for downscale in (1, 2, 2.5))
    count = len(scene.paths)
    cameras = scene.cameras
    require(count > 0 and len(cameras) == count, f"{name}: {count} paths but {len(cameras)} cameras")
    require(
        cameras.pose.dtype == torch.float64 and tuple(cameras.pose.shape) == (count, 3, 4),
        f"{name}: pose [V 3 4] fp64",
    )
    # Poses are rotations and positions: a scale or a mirroring would go unnoticed until the renders are
    # wrong.
    turn = cameras.pose[:, :, :3]
    rigid = close(turn @ turn.mT, torch.eye(3).double().expand(count, 3, 3), 1e-3)
    require(
        rigid and bool((torch.linalg.det(turn) > 0).all()), f"{name}: poses must be rotations, right-handed"
    )
    require(
        bool((cameras.focal > 0).all() and (cameras.size > 0).all()),
        f"{name}: focal lengths and sizes must be above 0",
    )
    # Held-out views must not be learnt from, and the same folder must give the same numbers each time.
    views = torch.cat([scene.train, scene.test])
    require(len(set(views.tolist())) == len(views), f"{name}: a view must not be in train and test")
    require(
        len(scene.train) > 0 and 0 <= int(views.min()) <= int(views.max()) < count,
        f"{name}: splits must index views",
    )
    for downscale, other in zip((2, 2.5), smaller, strict=True):
        fits = bool((other.cameras.size - scene.cameras.size / downscale).abs().max() <= 1)
        require(fits, f"{name}: downscale={downscale} must divide the size by it")
    require(
        parser.parse(data, 1).paths == scene.paths,
        f"{name}: the order of the views must be the same each time",
    )
    # Recognition looks at every folder that a user names: it must not claim what it cannot read.
    known = config.recognises(data)
    require(
        known is None or 0 < known.confidence <= 1,
        f"{name}: its confidence must lie in (0, 1], or None be given",
    )
    require(
        config.recognises(data / "no-such-folder") is None,
        f"{name}: must not recognise a folder that is absent",
    )
    require(config.recognises(scene.paths[0]) is None, f"{name}: must not recognise an image as a folder")
    try:
        parser.parse(data / "no-such-folder", 1)
    except DataError:
        return
    raise AssertionError(f"{name}: a folder that is absent must be a DataError")


def check_data_manager(config: DataManagerConfig) -> None:
    """Batches that are a function of (seed, step), of training views alone, with the colours and features of
    their pixels.
    """
    check_config(config)
    name = type(config).__name__
    encoder = RandomConfig(channels=5, stride=3).build()
    with tempfile.TemporaryDirectory() as folder:
        scene = cases.capture(Path(folder))

        def build(seed: int = 0, *, features: bool = True) -> DataManager:
            given = encoder if features else None
            return config.build(
                TrainingPixels(scene=scene),
                FeatureTargets(content=given, semantic=given, dim=3),
                cache=Path(folder, "cache"),
                seed=seed,
            )

        manager = build()
        again = build()
        plain = build(features=False)
        require(
            isinstance(manager, DataManager),
            f"{name}: build() gives {type(manager).__name__}, not a DataManager",
        )
        # A resumed run draws the batches of the one that was interrupted.
        batch = manager.batch(3)
        later = manager.batch(4)
        for other in (manager, again, manager.to(torch.device("cpu"), room=0)):
            for mine, theirs in zip(other.batch(3), batch, strict=True):
                equal = mine is theirs is None or (
                    mine is not None and theirs is not None and torch.equal(mine, theirs)
                )
                require(equal, f"{name}: a batch must be a function of the seed and the step")
        count = len(batch.rgb)
        require(config.batch_rays() == count, f"{name}: batch_rays() must be the rays of a batch, {count}")
        require(not torch.equal(batch.pixel, later.pixel), f"{name}: another step must bring other pixels")
        require(
            not torch.equal(batch.pixel, build(1).batch(3).pixel),
            f"{name}: another seed must bring other pixels",
        )
        tensor(batch.pixel, (count, 2), f"{name}: pixel")
        tensor(batch.rgb, (count, 3), f"{name}: rgb")
        require(
            batch.view.dtype == torch.int64 and batch.view.shape == (count,),
            f"{name}: view must be int64 [R]",
        )
        require(
            bool(torch.isin(batch.view, scene.train).all()),
            f"{name}: batches must be of training views alone",
        )
        # Colours and pixels belong together: each is looked up in the view that it names.
        corner = batch.pixel - 0.5
        inside = (corner == corner.floor()) & (corner >= 0) & (corner < scene.cameras.size[batch.view])
        require(bool(inside.all()), f"{name}: pixels must be centres, at +0.5, within their image")
        images = []
        for view in range(len(scene.paths)):
            images.append(manager.image(view))
        for image, (width, height) in zip(images, scene.cameras.size.tolist(), strict=True):
            tensor(image, (height, width, 3), f"{name}: image", low=0.0, high=1.0)
        parts = []
        for v, (x, y) in zip(batch.view.tolist(), corner.long().tolist(), strict=True):
            parts.append(images[v][y, x])
        shown = torch.stack(parts)
        same(batch.rgb, shown, 1e-6, f"{name}: rgb must be the colour of the pixel, as image() gives it")
        # Stores say what units and how many channels the fields are built with.
        content = manager.content_store
        semantic = manager.semantic_store
        require(
            content is not None and semantic is not None, f"{name}: must have stores where encoders are given"
        )
        assert content is not None and semantic is not None
        require(
            (content.channels, semantic.channels) == (5, 3),
            f"{name}: stores must have the encoder's channels, and `dim`",
        )
        require(
            batch.content is not None and batch.semantic is not None,
            f"{name}: batches must bring what stores hold",
        )
        assert batch.content is not None and batch.semantic is not None
        tensor(batch.content, (count, 5), f"{name}: content")
        tensor(batch.semantic, (None, 3), f"{name}: semantic")
        require(0 < len(batch.semantic) <= count, f"{name}: semantic must be of the first Q rays, 0 < Q <= R")
        require(plain.content_store is None and plain.semantic_store is None, f"{name}: no encoder, no store")
        bare = plain.batch(3)
        require(bare.content is None and bare.semantic is None, f"{name}: no encoder, no targets")
        require(torch.equal(bare.pixel, batch.pixel), f"{name}: pixels must not depend on the encoders")


def check_capture_format(form: "CaptureFormat") -> None:
    """A format reads what it writes: as many Gaussians of the same places and colours; recolouring changes
    nothing else.

    Damaged files end in DataError.
    """
    import numpy as np

    from ..splats.gaussians import Gaussians

    check_config(form)
    name = type(form).__name__
    path = Path("capture")
    if not (form.reads and form.writes):
        try:
            form.read(path, b"")
        except DataError:
            return
        require(False, f"{name}: an empty file must raise DataError")
    made = Gaussians(
        cases.normal(50, 3, seed=30),
        torch.nn.functional.normalize(cases.normal(50, 4, seed=31), dim=1),
        cases.normal(50, 3, seed=32) - 3,
        cases.normal(50, seed=33),
        0.3 * cases.normal(50, 4 if form.view_dependent else 1, 3, seed=34),
    )
    data = b"".join(form.pack(made, form.view_dependent, (0.0, 0.0, 0.0)))
    require(form.recognises(data[:64], len(data)), f"{name}.recognises: must be True of a file that it wrote")
    read = form.read(path, data)
    found = read.gaussians
    apart = torch.cdist(made.means, read.gaussians.means)
    require(len(found) == len(made), f"{name}: {len(found)} Gaussians come back of {len(made)}")
    require(
        read.antialiased == form.view_dependent, f"{name}: whether opacities are compensated must come back"
    )
    order = apart.argmin(1)
    same(found.means[order], made.means, 0.02, f"{name}: positions must come back")
    same(found.colours[order], made.colours, 0.05, f"{name}: colours must come back")
    require(read.data == data, f"{name}: Capture.data must be the file")
    # Every second colour is changed; geometry and the other colours stay bit for bit.
    changed = np.arange(len(found)) % 2 == 0
    new = torch.where(torch.from_numpy(changed)[:, None, None], 0.5 * found.harmonics, found.harmonics)
    again = form.read(path, b"".join(read.recolour(new.numpy(), changed))).gaussians
    for part in ("means", "quaternions", "log_scales", "logits"):
        same(
            getattr(again, part), getattr(found, part), 0.0, f"{name}.recolour: {part} must stay as they are"
        )
    same(again.colours, 0.5 + HARMONIC * new[:, 0], 0.05, f"{name}.recolour: the new colours must be there")
    # Files are cut short by full disks and broken downloads.
    for wrong in (b"", data[: len(data) // 2]):
        try:
            shorter = len(form.read(path, wrong).gaussians)
        except DataError:
            continue
        require(
            0 < shorter < len(made),
            f"{name}: a file that is cut off must raise DataError, or hold fewer Gaussians",
        )
