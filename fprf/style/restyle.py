"""References to a style on a scene: the feed-forward step, a second or less a photograph, and what holds for
single regions.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import ConfigError, UsageError
from ..scenes import Scene
from ..testing.outputs import check_stylizer
from .config import NO_MASK, labels
from .dictionary import Encoders, Reference, StyleDictionary, build_dictionary, encode_photograph
from .files import Keyframe, StyleFile, check_photographs, fade, read_style, with_folders
from .light import light_of
from .look import Restyle, colour_maps, decoded_colours, region_maps, regional
from .matching import unit
from .placed_light import placed_light
from .regions import RegionControls, Regions, region_controls
from .scene_style import RegionWeight, SceneStyle, own_style
from .seen_sun import light_of_style


class Codes(NamedTuple):
    """The style codes that points can take, of one style or of two that are mixed: what match maps speak
    of.
    """

    reference: Annotated[Tensor, "T"]
    names: tuple[str, ...]
    units: Annotated[Tensor, "T D"]
    """Directions of their keys from the scene's mean: cosines with these are scores."""


class Styled(NamedTuple):
    """A style on a scene."""

    restyle: Restyle
    dictionary: StyleDictionary
    scene_style: SceneStyle
    codes: Codes
    controls: RegionControls


@torch.inference_mode()
def apply_style(
    scene: Scene,
    file: StyleFile,
    encoders: Encoders | None = None,
    trail: tuple[Path, ...] = (),
    encoded: dict[tuple[Path, Path], Reference] | None = None,
) -> Styled:
    """Build the dictionary of a style's references and its stylizer on the scene; mix in the style that it
    goes towards.

    `trail` are the style files that led here. `encoded` keeps photographs with their masks for further
    styles. Raises UsageError for no references and for regions that the scene does not have, DataError for
    unreadable photographs, WeightsError where the encoders are not the scene's.
    """
    style = with_folders(file.style)
    if not style.references and not style.light_asked:
        raise UsageError(
            "--references: at least one photograph is needed, for example --references autumn.jpg night.jpg, or a "
            "light, for example --light golden-hour"
        )
    # Photographs are encoded once, whatever name, weight or style they are used under.
    if encoders is None:
        encoders = scene.encoders()
    if encoded is None:
        encoded = {}
    if not style.references:
        return _light_alone(scene, file._replace(style=style), encoders)
    references = []
    for i, (path, name) in enumerate(zip(style.references, labels(style.references), strict=True)):
        mask = NO_MASK
        if style.masks:
            mask = style.masks[i]
        weight = 1.0
        if style.weights:
            weight = style.weights[i]
        if (path, mask) not in encoded:
            painted = None if mask == NO_MASK else mask
            encoded[path, mask] = encode_photograph(path, encoders, name=name, mask=painted)
        references.append(encoded[path, mask]._replace(name=name, weight=weight))
    dictionary = build_dictionary(references, clusters=style.clusters, blend=style.blend, seed=encoders.seed)
    styled = apply_dictionary(scene, file._replace(style=style), encoders, dictionary)
    if style.between is None or style.at == 0:
        return styled
    # The other style is built alike, and so is the one that it goes towards itself.
    path = style.between.resolve()
    if path in trail:
        raise ConfigError(f"{style.between}: lies between styles that lead back to it; end the circle")
    other = read_style(style.between)
    check_photographs(style.between, other)
    return mixed(styled, apply_style(scene, other, encoders, (*trail, path)), style.at)


@torch.inference_mode()
def apply_dictionary(
    scene: Scene, file: StyleFile, encoders: Encoders, dictionary: StyleDictionary
) -> Styled:
    """Build the look of a style whose dictionary is built already. `between` is not heeded.

    The dictionary's names are the labels of the style's references. Raises UsageError for regions that the
    scene does not have.
    """
    style = file.style
    if style.lit and scene.decoder is not None:
        raise UsageError(
            "--sun, --light: light falls on Gaussians; bring the fields into that form first, with fprf export RUN ply"
        )
    scene_style = encoders.scene_style
    basis = encoders.basis
    # Cosines that are not centred start from the encoder's zero, which the basis knows.
    if basis is not None:
        dictionary = dictionary._replace(origin=basis.origin().to(dictionary.keys))
    controls = region_controls(
        Regions(scene, scene_style, basis, file.regions, file.semantic_encoder), dictionary, style
    )
    if controls.places and scene.decoder is not None:
        raise UsageError(
            "--pin: places are for Gaussians; for a run of fields pin regions, such as --pin 3=autumn.jpg"
        )
    known = light_of_style(style)
    config = style.stylizer
    device = scene.device
    partly = bool((controls.strength != 1).any())
    weight = None
    if partly:
        weight = RegionWeight(scene_style, controls.strength[:, None]).to(device)

    def look(allowed: Annotated[Tensor, "K references"]) -> Restyle:
        """The look of one choice of references: stylizer, colours behind the decoder, and light where matches
        are not sure.
        """
        stylizer = regional(dictionary, scene_style, allowed, config)
        check_stylizer(
            config, stylizer, dictionary, scene_style, affine=scene.decoder is None and config.colours <= 0
        )
        stylizer = stylizer.to(device)
        if scene.decoder is None:
            colours = region_maps(stylizer, dictionary, scene_style, config, allowed)
        else:
            colours = colour_maps(
                stylizer,
                dictionary,
                scene_style,
                scene.decoder,
                features=config.features,
                share=config.colours,
                smoothing=config.smoothing(scene_style, allowed),
            )
        placed = None
        light = None
        if config.light:
            colours_before = decoded_colours(stylizer, scene_style, scene.decoder, features=0.0)
            placed = placed_light(scene_style, dictionary, allowed, colours_before)
            light = light_of(
                scene_style, dictionary, config, colours_before, bold=style.bold, allowed=allowed
            )
        return Restyle(
            stylizer,
            strength=style.strength,
            regions=weight,
            features=config.features,
            colours=None if colours is None else colours.to(device),
            luminance=style.luminance,
            sun=known.config,
            light=None if light is None else light.to(device),
            placed=None if placed is None else placed.to(device),
        )

    places = tuple((place.about(scene.origin), look(allowed)) for place, allowed in controls.places)
    codes = Codes(dictionary.reference, dictionary.names, unit(dictionary.keys, scene_style.semantic_mean))
    if config.light:
        controls = controls._replace(notes=(*controls.notes, *_recognised(dictionary)))
    if known.note:
        controls = controls._replace(notes=(*controls.notes, known.note))
    return Styled(replace(look(controls.allowed), places=places), dictionary, scene_style, codes, controls)


def _recognised(dictionary: StyleDictionary) -> list[str]:
    """A line for each reference that shows the very place."""
    lines = []
    for i, pairs in enumerate(dictionary.placed):
        if pairs is not None:
            agreeing = f"{pairs.agreeing} points agree with a view"
            lines.append(
                f"{dictionary.names[i]}: shows this very place ({agreeing}); its light is measured there"
            )
    return lines


def _light_alone(scene: Scene, file: StyleFile, encoders: Encoders) -> Styled:
    """A light on the scene's own colours, without photographs."""
    style = file.style
    still = file._replace(style=replace(style, strength=0.0))
    own = own_style(encoders.scene_style, style.blend)
    # Of Gaussians the content is the colour: the scene stands in the place of photographs of itself.
    own = own._replace(colour_mean=own.mean.clone(), colour_covariance=own.covariance.clone())
    styled = apply_dictionary(scene, still, encoders, own)
    saved = styled.controls.saved
    saved = saved._replace(style=replace(saved.style, strength=style.strength))
    return styled._replace(controls=styled.controls._replace(saved=saved))


def mixed(a: Styled, b: Styled, at: float) -> Styled:
    """Style `a` on the way to `b`, which lies at 1.

    The dictionary and the controls stay those of `a`; codes and notes are those of both.
    """
    # Codes of both, one after the other, as `Restyle.match` lists them.
    reference = torch.cat([a.codes.reference, b.codes.reference + len(a.codes.names)])
    codes = Codes(reference, a.codes.names + b.codes.names, torch.cat([a.codes.units, b.codes.units]))
    controls = a.controls._replace(notes=a.controls.notes + b.controls.notes)
    return a._replace(restyle=a.restyle.mixed(b.restyle, at), codes=codes, controls=controls)


def keyed_looks(scene: Scene, keys: Sequence[Keyframe]) -> Callable[[int], Restyle | None]:
    """The look of each frame; every style is built once, before the first frame."""
    encoders = scene.encoders()
    looks: dict[Path | None, Restyle | None] = {None: None}
    for key in keys:
        if key.style is not None and key.style not in looks:
            file = read_style(key.style)
            check_photographs(key.style, file)
            styled = apply_style(scene, file, encoders, (key.style.resolve(),))
            looks[key.style] = styled.restyle
            for note in styled.controls.notes:
                print(f"{key.style}: {note}")
    # Between two keys one look fades into the other; to and from the plain scene by its strength.
    frames = []
    for key in keys:
        frames.append(key.frame)

    def look(at: int) -> Restyle | None:
        before, after, way = fade(frames, at)
        first = looks[keys[before].style]
        second = looks[keys[after].style]
        if way == 0 or second is first:
            return first
        if first is None:
            if second is None:
                return None
            return second.faded.mixed(second, way)
        return first.mixed(first.faded if second is None else second, way)

    return look
