"""The scene that is viewed: its state (`state.py`), its clients' requests, its photographs, films and
training.

Calls come from any thread. What touches the model runs on the render worker; clients learn of the results by
messages, of which a newer one of the same kind takes the place of one that was not sent yet. The run folder
is the only channel to a training: its newest checkpoint is shown, and as long as somebody looks the folder
says so (`training.driver.watch`), for which training saves more often.
"""

import hashlib
import secrets
import shutil
import threading
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from ..errors import DataError, FprfError, UsageError
from ..io.atomic import write_bytes
from ..io.images import Picture, encode
from ..rendering.local_frame import read_offset
from ..scenes import Scene
from ..splats.files import Capture
from ..splats.scene import SplatScene
from ..style.config import StyleConfig
from ..style.files import read_style
from ..training.loading import LoadedRun
from . import messages
from .downloads import SAVED_FORMATS, controls_of, write_shown, write_style_of
from .drawing import (
    Restyler,
    ScenePainter,
    cameras_of,
    gaussian_colours,
    matching_regions,
    picture_of,
    rules_of,
)
from .films import start_film, write_film_files
from .lighting import Lights
from .looks import Look, Photograph, Shown, sliders
from .pack import colour_header, colour_section, container
from .render_worker import RenderWorker, Steps
from .saved import (
    PageFile,
    Regions,
    digest_of,
    folder_of,
    made_of,
    name_within,
    photograph_file,
    read_page,
    regions_before,
    regions_now,
    write_page,
)
from .state import NOW, FilmProgress, History, Made, SharedState
from .uploads import Uploads, shown_name, unpack_style
from .writer import about, packed_scene

Post: TypeAlias = Callable[[Hashable | None, str, "Mapping[str, Any] | bytes"], None]
"""Sends a client, or all (None), a message under the name of its kind."""
_PREVIEW_JPEG_QUALITY = 72
"""Quality of a preview, which is soon replaced; by eye."""
_FINAL_JPEG_QUALITY = 90
"""Quality of the whole picture; by eye."""
_MAX_PREVIEW_BYTES = 1 << 20
"""Bytes of a picture of what a page shows; the page sends some ten thousand."""
_SAVING_DELAY_SECONDS = 1.0
"""From a change until it is kept on disk: a slider makes many; by eye."""


@dataclass(frozen=True)
class Viewed:
    """A scene with what the page says of it."""

    scene: Scene
    name: str
    home: int
    """View at which clients begin."""
    root: Path | None = None
    """Folder for films: that of a run; None = there is none."""
    capture: Capture | None = None
    """The file of Gaussians that it was read from; None = it is a run."""
    style: StyleConfig = StyleConfig()
    """Style that looks start from."""
    step: int = 0
    """Step of the checkpoint that it was read from."""
    references: tuple[Path, ...] = ()
    """Photographs that are on the shelf at the beginning; several are mixed, and those that come later join
    them.
    """
    pixels: int = 640
    """Longest side of the sharpest picture."""


def view_of_run(opened: LoadedRun[Scene]) -> Viewed:
    """A run, beginning at the middle one of the views that training did not see."""
    views = opened.known.test or opened.known.train
    return Viewed(opened.scene, opened.known.name, views[len(views) // 2], opened.run.root, step=opened.step)


class Session:
    """Use as a context manager, which ends its threads and processes."""

    def __init__(self, viewed: Viewed, post: Post) -> None:
        self.viewed = viewed
        self._post = post
        self._key = secrets.token_hex(8)
        """Tells pages that a server's scene is another one, also after the server was started anew."""
        self.restyler = Restyler(viewed.scene)
        self.state = SharedState(look=Look(style=viewed.style), together=len(viewed.references) > 1)
        self.uploads = Uploads()
        self._lock = threading.RLock()
        self._requests: dict[Hashable, messages.ViewRequest] = {}
        self._photographs: frozenset[Photograph] = frozenset()
        self._painter: ScenePainter | None = None
        self._worker = RenderWorker(self._on_error)
        self._version = count(1)
        self._colours: dict[str, tuple[int, bytes]] = {}
        self._lights: Lights | None = None
        self._progress: dict[str, Any] | None = None
        self._history = History()
        self._digests: dict[Photograph, str] = {}
        self._saving: threading.Timer | None = None
        self._load(self._tell_opening)
        # What was made before comes back first; until then nothing is written over it.
        self._folder: Path | None = None
        self._of = ""
        self._before: PageFile | None = None
        if viewed.root is not None:
            if viewed.capture is not None:
                self._of = name_within(viewed.root, viewed.capture.path)
            self._folder = folder_of(viewed.root, self._of)
            self._before = read_page(self._folder)

    def __enter__(self) -> "Session":
        self._worker.start()
        if self._before is not None:
            self._worker.run_when_idle(self._restore(self._before))
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.close()  # a film that is being made is left unfinished
        if self._saving is not None:
            self._saving.cancel()
            self._save()
        self.uploads.close()

    def _restore(self, page: PageFile) -> Steps[None]:
        """Bring back what was made before, beside what has been made since."""
        assert self._folder is not None
        found: dict[str, Photograph] = {}
        for number, (digest, name) in enumerate(page.photographs.items()):
            text = f"{number} of {len(page.photographs)} photographs of before"
            self.tell("restoring", text, number / len(page.photographs))
            try:
                data = photograph_file(self._folder, digest).read_bytes()
                found[digest] = self.restyler.encode(self.uploads.store(data), name)
                self._digests[found[digest]] = digest
            except (FprfError, OSError) as error:
                self.notify(f"{name}: left out of what was kept: {error}", bad=True)
            yield
        for each in self.state.shelf:  # one that has come meanwhile takes the place of the one of before
            if (digest := digest_of(each.path.read_bytes())) in found:
                found[digest] = each
        try:
            made = made_of(page, found)
            if page.regions is not None:
                made = self._renumbered(made, page.regions)
            self.apply(lambda state: state.joined(made), undoable=False)
            self._photographs |= frozenset(found.values())
        except FprfError as error:
            self.notify(f"{self._folder}: {error}", bad=True)
            self._folder = None  # nothing is written over it
        self._before = None
        self._save_soon()
        self.tell("restoring", "", None)

    def _renumbered(self, made: Made, regions: Regions) -> Made:
        """Work of users, with the regions that it speaks of as they are numbered now."""
        now = self.restyler.encoders.scene_style
        before = regions_before(regions, now)
        if before is None:
            self.notify("rules for regions were left out: the scene has other semantics now", bad=True)
            return made.without_rules()
        return made.renumbered(matching_regions(before, now).tolist())

    def _save_soon(self) -> None:
        """Keep what was made in the scene's folder, a moment from now."""
        with self._lock:
            if self._folder is None or self._before is not None or self._saving is not None:
                return
            self._saving = threading.Timer(
                _SAVING_DELAY_SECONDS, lambda: self._worker.run("save", self._save)
            )
            self._saving.daemon = True
            self._saving.start()

    def _save(self) -> None:
        with self._lock:
            self._saving = None
            made = self.state.made
            folder = self._folder
        if folder is None:
            return
        regions = None
        if any(look.rules for look in made.looks):
            regions = regions_now(self.restyler.encoders.scene_style)
        try:
            write_page(folder, made, self._of, regions, self._digests)
        except (FprfError, OSError) as error:
            self._folder = None  # said once
            self.notify(f"looks and photographs are not kept: {error}", bad=True)

    def _tell_opening(self, share: float) -> None:
        what = f"{self.viewed.name}: preparing it for the browser"
        self.tell("opening", what, messages.SEARCHED_SHARE + (1 - messages.SEARCHED_SHARE) * share)

    def _load(self, progress: Callable[[float], None] = lambda share: None) -> None:
        """Prepare what browsers are sent of Gaussians, or the painter of any other scene."""
        scene = self.viewed.scene
        home = self.viewed.home
        if isinstance(scene, SplatScene):
            # Shapes and captured colours go to browsers once.
            self.packed, head, parts = packed_scene(
                scene, [scene.gaussians.harmonics], home, level=1, progress=progress
            )
            self.geometry = container(head, parts)
            self._lights = Lights(
                scene, self.packed.order, self._worker, self._post, self.tell, self._version
            )
        else:
            self._painter = ScenePainter(scene, self.restyler, self._show, self.viewed.pixels)
            # A camera turns about a point as far away as most cameras are from their middle.
            place = scene.cameras.pose[:, :, 3]
            spread = float((place - place.median(dim=0).values).norm(dim=1).quantile(0.9)) or 1.0
            self.geometry = container(about(scene.cameras, home, lambda view: 1.5 * spread, up=scene.up), {})

    def hello(self) -> list[tuple[str, dict[str, Any]]]:
        """Messages for a new client."""
        drawn_there = isinstance(self.viewed.scene, SplatScene)
        viewed = self.viewed
        scene = {
            "type": "scene",
            "key": self._key,
            "name": viewed.name,
            "gaussians": drawn_there,
            "step": viewed.step,
        }
        coloured = [*self._colours.items()]  # the worker goes on changing them
        ready = []
        for name, (version, _) in coloured:
            ready.append((f"colours {name}", _colours_message(name, version)))
        if self._lights is not None:
            ready.extend(self._lights.hello())
        if self._progress is None:
            training = []
        else:
            training = [("training", self._progress)]
        return [("scene", scene), ("state", self._described()), *ready, *training]

    def _described(self) -> dict[str, Any]:
        """The state as the page reads it."""
        history = self._history
        return {
            **self.state.described(),
            "defaults": sliders(self.viewed.style),
            "undo": bool(history.before),
            "redo": bool(history.after),
            "keeps": str(self._folder) if self._folder is not None else "",
        }

    def handle(self, client: Hashable, message: messages.AnyMessage) -> None:
        """Do what a client asks for. Raises FprfError with what is wrong with it."""
        match message:
            case messages.ViewRequest():
                # Browsers draw Gaussians themselves; all else is drawn here.
                if self._painter is not None:
                    cameras_of([message.camera])  # refused where it is none
                    with self._lock:
                        self._requests[client] = message
                    self._worker.draw(client, self._painter.render(client, message, self.state.shown))
            case messages.Pick():
                # The place is a share of the canvas; its right and lower edges belong to the last pixels.
                cameras = cameras_of([message.camera], longest=1000)
                width, height = cameras.size[0].tolist()
                at = (min(message.x * width, width - 1e-3), min(message.y * height, height - 1e-3))
                self._worker.run("pick", lambda: self._select(self.restyler.region_at(cameras, at)))
            case messages.Film():
                self._record(message)
            case messages.Undo():
                move = self._history.redo if message.again else self._history.undo
                self.apply(lambda state: state.remade(move(state.made)), undoable=False)
            case _:
                if isinstance(message, messages.Key) and message.camera is not None:
                    cameras_of([message.camera])  # refused where it is none
                control: Hashable = None
                if isinstance(message, messages.Set):
                    control = message.name
                if isinstance(message, messages.Card) and message.action == "weight":
                    control = message.card
                if isinstance(message, messages.Sun):
                    control = self.lights  # refused where there are none
                self.apply(lambda state: state.changed(message), control=control)
                if isinstance(message, messages.Sun):
                    self._relight(NOW, self.state.shown, moving=message.moving)

    def disconnect(self, client: Hashable) -> None:
        """Drop everything of a client."""
        with self._lock:
            self._requests.pop(client, None)
        self._worker.forget(client)
        if (painter := self._painter) is not None:
            self._worker.run(("forget", client), lambda: painter.forget(client))

    def notify(self, text: str, *, bad: bool = False) -> None:
        """Show a line of text to all clients."""
        self._post(None, f"said {next(self._version)}", {"type": "said", "text": text[:400], "bad": bad})

    def tell(self, kind: str, what: str, share: float | None) -> None:
        """Tell all clients how far something is that takes its time; done where `what` is empty."""
        self._post(None, f"wait {kind}", {"type": "wait", "kind": kind, "what": what, "share": share})

    def apply(
        self,
        change: Callable[[SharedState], SharedState],
        *,
        undoable: bool = True,
        control: Hashable = None,
    ) -> None:
        """Replace the state for all clients. Raises what `change` raises.

        What was made so far can be undone, if the change is to be `undoable`; changes of one `control` are
        one step.
        """
        # Clients change the state one after the other, each what the one before it left.
        with self._lock:
            before = self.state
            self.state = change(self.state)
            now = self.state
            remade = now.made != before.made
            if remade and undoable:
                self._history.note(before.made, control)
        if remade:
            self._save_soon()
            self._colour_kept(before, now)
        if now.picked is not None and now.look != before.look:
            region = now.picked.region  # what it takes has changed
            self._worker.run("select", lambda: self._describe(region))
        # What is seen is drawn again only where it is another; names and lists of the page cost a message
        # alone.
        if now.shown.unlit != before.shown.unlit:
            self._refresh()
        if now.shown.light != before.shown.light and control is not self._lights:
            self._relight(NOW, now.shown)
        if now != before:
            self._post(None, "state", self._described())

    def _colour_kept(self, before: SharedState, now: SharedState) -> None:
        """A look of Gaussians that is kept is a style of the page, with colours of its own."""
        if not isinstance(self.viewed.scene, SplatScene):
            return
        known = dict(before.kept)
        for name in known.keys() - dict(now.kept).keys():
            self._worker.run(("kept", name), partial(self._colours.pop, name, None))
            self._relight(name, Shown(Look()))
        for name, look in now.kept:
            if known.get(name) != look:
                self._worker.run(("kept", name), partial(self._colour, name, Shown(look)))
                self._relight(name, Shown(look))

    def upload(self, data: bytes, name: str, *, join: bool = False) -> Photograph:
        """Decode and encode a photograph and restyle the scene with it, and with those that it is to `join`.
        Raises DataError for what is none.
        """
        shown = shown_name(name)

        def add(path: Path) -> Photograph:
            self.tell("photograph", f"{shown}: finding what it shows", 1 / 3)
            photograph = self.restyler.encode(path, self.state.unused_name(shown))
            self.tell("photograph", f"{shown}: giving the scene its style", 2 / 3)
            self.apply(lambda state: state.added(photograph, join))
            # Photographs that left the shelf and that no look needs go, with what was made of them: some 6 MB
            # each.
            self._drop_unused([photograph])
            return photograph

        try:
            self.tell("photograph", f"{shown}: reading it", 0.0)
            path = self.uploads.store(data)
            return self._worker.result(partial(add, path))
        finally:
            self.tell("photograph", "", None)
            self.tell("looking", "", None)  # at a capture, where that has failed

    def _drop_unused(self, new: Iterable[Photograph]) -> None:
        used = self.state.in_use | frozenset(self.state.shelf) | self._history.photographs
        for gone in {*self._photographs, *new} - used:
            gone.path.unlink(missing_ok=True)
        self._photographs = used
        self.restyler.retain(used)

    def warm_up(self) -> None:
        """Prepare what the first photograph needs while nobody waits: decoder, encoders, kernels, a style."""
        threading.Thread(target=self.uploads.start_decoder, name="fprf-warm-up", daemon=True).start()

        def work() -> Steps[None]:
            self.restyler.encoders  # noqa: B018  they are opened by asking for them
            yield
            # A gradient in the place of a photograph: all that a drop runs is loaded and compiled by it.
            path = self.uploads.folder / "warm-up.png"
            path.write_bytes(
                encode(np.linspace(0, 255, 96 * 128 * 3).reshape(96, 128, 3).astype(np.uint8), "png")
            )
            photograph = self.restyler.encode(path, "warm-up")
            yield
            styled = self.restyler.styled(Look(style=self.viewed.style).mixed([(photograph, 1.0)]))
            yield
            if styled is not None and isinstance(self.viewed.scene, SplatScene):
                self.packed.colours(self.viewed.scene.restyled(styled.restyle).shown.harmonics, rounds=1)
            self.restyler.retain(self._photographs)

        self._worker.run_when_idle(work())

    def reload(self, viewed: Viewed) -> None:
        """Show another state of the scene, from the next step of the worker on."""

        def job() -> None:
            self.viewed = viewed
            before = self.restyler.reload(viewed.scene)
            self._load()
            # Clients fetch shapes and colours anew: Gaussians of this state are others. What had colours is
            # coloured again.
            coloured = [*self._colours]
            self._colours.clear()
            for kind, message in self.hello():
                self._post(None, kind, message)
            # Regions are measured anew, in any order: what is pinned is found again among them.
            picked = self.state.picked
            looks = (*self.state.looks, *self._history.looks)
            if before is not None and (picked is not None or any(look.rules for look in looks)):
                regions = matching_regions(before, self.restyler.encoders.scene_style).tolist()
                self._history.renumber(regions)
                self.apply(lambda state: state.renumbered(regions), undoable=False)
                if picked is not None:
                    self._select(regions[picked.region])
            for name, look in self.state.kept:
                if name in coloured:
                    self._worker.run(("kept", name), partial(self._colour, name, Shown(look)))
                    self._relight(name, Shown(look))
            if NOW in coloured or not self.state.look.plain:
                self._refresh()
                self._relight(NOW, self.state.shown)

        self._worker.run("reload", job)

    def trained(self, progress: Mapping[str, Any]) -> None:
        """Tell all clients how far the scene's training is."""
        self._progress = {"type": "training", **progress}
        self._post(None, "training", self._progress)

    def colours(self, name: str) -> bytes:
        """Colours of the present look or of a kept one, for a browser. Raises UsageError where there are
        none.
        """
        if (found := self._colours.get(name)) is None:
            raise UsageError(f"{name}: no such colours")
        return found[1]

    @property
    def lights(self) -> Lights:
        """Lights of looks, for browsers. Raises UsageError where there are no Gaussians."""
        if self._lights is None:
            raise UsageError("light falls on Gaussians; `fprf export` makes some of a field")
        return self._lights

    def gaussians(self, shown: str, start: str, share: float, suffix: str) -> Path:
        """The Gaussians as they are shown, in a file: in the look `shown`, or so far on the way to it from the
        look `start`, in [0, 1]. `suffix` is one of `SAVED_FORMATS`.

        Raises UsageError for a scene without any, and for looks and formats that there are none of.
        """
        viewed = self.viewed
        scene = self.viewed.scene
        if not isinstance(scene, SplatScene):
            raise UsageError(f"{viewed.name}: no Gaussians; `fprf export` makes some of a field")
        if suffix not in SAVED_FORMATS:
            raise UsageError(f"{suffix[:20]!r}: Gaussians are saved as {', '.join(SAVED_FORMATS)}")
        look = self.state.look_named(shown)
        before = self.state.look_named(start)

        def written() -> Path:
            # Under a name of its own: another page may still be reading the one before, which its open file
            # keeps.
            for old in self.uploads.folder.glob("restyled-*"):
                old.unlink()
            path = self.uploads.folder / f"restyled-{next(self._version)}{suffix}"
            gaussians = scene.restyled(self.restyler.restyle(look)).shown
            if share < 1 and before != look:
                first = scene.restyled(self.restyler.restyle(before)).shown.harmonics
                gaussians = gaussians.recoloured(torch.lerp(first, gaussians.harmonics, share))
            write_shown(path, scene, viewed.capture, gaussians)
            if any(offset := read_offset(path)):
                place = " ".join(f"{x:g}" for x in offset)
                self.notify(f"{suffix} holds positions relative to {place}; .ply holds them as they are")
            return path

        return self._worker.result(written)

    def style_archive(self, shown: str) -> Path:
        """A look as style.json with its photographs, in a .zip that `read_style_archive` and, unpacked, `fprf
        stylize` take. Raises UsageError for the scene as captured.
        """
        look = self.state.look_named(shown)

        def written() -> Path:
            styled = self.restyler.styled(look)
            if styled is None:
                raise UsageError(f"{shown}: the scene as it is has no style; choose a look")
            folder = self.uploads.folder / f"style-{next(self._version)}"
            write_style_of(folder / "style.json", look, styled.controls.saved)
            return Path(shutil.make_archive(str(folder), "zip", folder))

        return self._worker.result(written)

    def take_style(self, data: bytes) -> None:
        """Take up a look from a .zip of `style_archive`, or a style.json alone whose photographs are on the
        shelf. Raises DataError or ConfigError for what is none.
        """
        folder = self.uploads.folder / f"given-{next(self._version)}"
        path = unpack_style(data, folder)
        try:
            file = read_style(path)
            if file.style.masks or file.style.region_strength or file.style.between is not None:
                self.notify("style: masks, strengths of regions and a second style are left out here")
            photographs = []
            for reference in file.style.references:
                # Beside the file alone: no request names a path of this machine.
                beside = folder / reference.name
                photographs.append(self._given(beside, file.sha256.get(reference)))

            def add() -> None:
                found = []
                for known, png, name in photographs:
                    if known is None:
                        known = self.restyler.encode(png, self.state.unused_name(name))
                    found.append(known)
                rules = rules_of(self.restyler, file, found)
                weights = file.style.weights or (1.0,) * len(found)
                look = Look(
                    mix=tuple(zip(found, weights, strict=True)), style=controls_of(file.style), rules=rules
                )
                self.apply(lambda state: state.taken(look))
                self._drop_unused(found)

            self._worker.result(add)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _given(self, path: Path, sha256: str | None) -> tuple[Photograph | None, Path, str]:
        """A photograph of a style that was sent: one of the shelf, or a file and its name."""
        for each in self.state.shelf:
            if sha256 is not None and hashlib.sha256(each.path.read_bytes()).hexdigest() == sha256:
                return each, each.path, each.name
        if not path.is_file():
            raise DataError(
                f"style.json: its photograph {path.name} is not here; give the .zip, or drop the photograph first"
            )
        return None, self.uploads.store(path.read_bytes()), shown_name(path.name)

    def picture(self, asked: messages.PictureRequest) -> bytes:
        """A PNG of a scene that is drawn here, as a client sees it. Raises UsageError as `cameras_of`."""
        scene = self.viewed.scene
        cameras = cameras_of([asked.camera], longest=asked.side)
        look = self.state.look_named(asked.shown)

        def work() -> Steps[Picture]:
            restyle = self.restyler.restyle(look)
            return (yield from picture_of(scene, cameras, restyle, asked.wipe))

        return encode(self._worker.result_when_idle(work()), "png")

    def keep_preview(self, data: bytes) -> None:
        """Keep a small picture of what a page shows, for the list of scenes. Raises DataError for what is none."""
        root = self.viewed.root
        if root is None or not root.is_dir() or len(data) > _MAX_PREVIEW_BYTES:
            return
        path = self.uploads.store(data)
        write_bytes(root / "page" / "preview.png", path.read_bytes())
        path.unlink()

    def _refresh(self) -> None:
        """Show all clients what is shown now."""
        with self._lock:
            for client, request in self._requests.items():
                assert self._painter is not None  # Gaussians are drawn by browsers, which request nothing
                self._worker.draw(client, self._painter.render(client, request, self.state.shown))
        if isinstance(self.viewed.scene, SplatScene):
            self._worker.run("colours", lambda: self._colour(NOW, self.state.shown))

    def _show(self, client: Hashable, kind: str, picture: Picture, final: bool) -> None:
        """A picture as one byte for its kind, and a JPEG."""
        import cv2

        if final:
            quality = _FINAL_JPEG_QUALITY
        else:
            quality = _PREVIEW_JPEG_QUALITY
        done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        assert done
        self._post(client, kind, (b"\1" if kind == "captured" else b"\0") + data.tobytes())

    def _colour(self, name: str, shown: Shown) -> None:
        """Make colours for browsers, of what is shown now or of a look that is kept."""
        scene = self.viewed.scene
        assert isinstance(scene, SplatScene)
        what = f"Colouring {len(scene.gaussians):,} Gaussians"
        try:
            colours = gaussian_colours(
                scene, self.packed, self.restyler, shown, lambda share: self.tell("colouring", what, share)
            )
        finally:
            self.tell("colouring", "", None)
        version = next(self._version)
        self._colours[name] = (
            version,
            container(colour_header(colours), {"rows": colour_section(colours, 1)}),
        )
        self._post(None, f"colours {name}", _colours_message(name, version))

    def _relight(self, name: str, shown: Shown, *, moving: bool = False) -> None:
        """Light Gaussians in browsers, of what is shown now or of a look that is kept."""
        if self._lights is not None:
            if name == NOW and NOW not in self._colours:
                self._refresh()
            self._lights.relight(name, shown.light, moving=moving)

    def _select(self, region: int | None) -> None:
        picked = None
        if region is not None:
            picked = self.restyler.region_info(self.state.look, region)
        self.apply(lambda state: replace(state, picked=picked))

    def _describe(self, region: int) -> None:
        """Say anew what the picked region takes, unless another was picked or it was closed meanwhile."""
        found = self.restyler.region_info(self.state.look, region)

        def described(state: SharedState) -> SharedState:
            if state.picked is None or state.picked.region != region:
                return state
            return replace(state, picked=found)

        self.apply(described)

    def _record(self, film: messages.Film) -> None:
        """Make a film in the scene's folder while no client waits for a picture, one at a time."""
        with self._lock:
            if self.state.film.total and self.state.film.path is None:
                raise UsageError("film: one is being made; wait for it")
            if self.viewed.root is None:
                raise UsageError("this scene has no folder to put a film in")
            films = self.viewed.root / "films"
            scene = self.viewed.scene
            folder = next(each for number in count(1) if not (each := films / f"{number:04d}").exists())
            write_film_files(folder, self.state.keys, film, scene)
            self.apply(lambda state: replace(state, film=FilmProgress(total=1)))

        def progress(now: FilmProgress) -> None:
            self.apply(lambda state: replace(state, film=now))

        start_film(folder, scene, film.fps, self._worker, progress, self.notify)

    def _on_error(self, error: Exception) -> None:
        expected = isinstance(error, FprfError)
        if expected:
            text = str(error)
        else:
            text = f"this should not have happened: {type(error).__name__}: {error}"
        self.notify(text, bad=True)


def _colours_message(name: str, version: int) -> dict[str, Any]:
    return {"type": "colours", "name": name, "version": version}
