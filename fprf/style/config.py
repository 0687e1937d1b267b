"""Everything that makes a style, as one config: the flags of `fprf stylize` and the content of a
`style.json`. No torch.

What users say of regions is `REGION`, `REGION=REFERENCE` or `REGION=NUMBER`. A region is named by its number,
by its name in a style file, by a pixel of a view (`VIEW:X,Y`) or by a mask over one (`VIEW:MASK.png`), and in
pins on Gaussians by a place (`parse_place`); a reference by its file or by its number, from 0 in the order
given. What each text means is found out on a scene (`style.regions`); here is only the grammar.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from ..checks import at_least, between
from ..errors import ConfigError, UsageError
from ..light.config import SunConfig
from ..plugins import slots
from ..plugins.conversion import convert_fields
from ..plugins.registry import nearest
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig

if TYPE_CHECKING:
    from ..types import Origin

_PIXEL_PATTERN = re.compile(r"(-?\d+(?:\.\d+)?),(-?\d+(?:\.\d+)?)")


class RegionValue(NamedTuple):
    """A value for a region."""

    region: str
    value: str


class Place(NamedTuple):
    """A part of space, in the capture's coordinates: a box, or all that lies near to a path."""

    points: tuple[tuple[float, ...], ...]
    """Lowest and highest corner of the box, or the corners of the path."""
    width: float | None
    """Of the path, from side to side; None = a box."""
    border: float
    """Width of the soft border around it; 0 = a sharp one."""

    def about(self, origin: "Origin") -> "Place":
        """Move the place into the local frame of an origin."""
        return self._replace(
            points=tuple(tuple(x - of for x, of in zip(each, origin, strict=True)) for each in self.points)
        )


def parse_place(field: str, text: str) -> Place | None:
    """Parse `box:X,Y,Z:X,Y,Z[:BORDER]`, `path:X,Y,Z:X,Y,Z[...]:WIDTH[,BORDER]` or `everywhere`; None for
    another region.

    Raises ConfigError naming the field.
    """
    kind, *parts = text.split(":")
    if text == "everywhere":
        return Place(((-math.inf,) * 3, (math.inf,) * 3), None, 0.0)
    if kind not in ("box", "path"):
        return None
    try:
        numbers = []
        for part in parts:
            numbers.append(tuple(map(float, part.split(","))))
    except ValueError:
        numbers = []
    # Corners have three numbers each; what follows them are the sizes.
    count = next((k for k, each in enumerate(numbers) if len(each) != 3), len(numbers))
    points = numbers[:count]
    sizes = numbers[count:]
    size: tuple[float, ...] = ()
    if len(sizes) == 1:
        size = sizes[0]
    known = not any(map(math.isnan, sum(points, ())))
    given = known and all(0 <= value < math.inf for value in size)
    if kind == "box" and given and len(points) == 2 and len(sizes) <= 1 and len(size) == len(sizes):
        low = tuple(map(min, *points))
        high = tuple(map(max, *points))
        return Place((low, high), None, *(size or (0.0,)))
    if kind == "path" and given and len(points) >= 2 and size and all(map(math.isfinite, sum(points, ()))):
        return Place(tuple(points), size[0], size[1] if len(size) > 1 else 0.0)
    raise ConfigError(
        f"{field}: {text!r} is no place; write box:X,Y,Z:X,Y,Z:BORDER, for example box:-4,-2,0:4,2,9:0.5, or "
        "path:X,Y,Z:X,Y,Z:WIDTH,BORDER"
    )


def parse_region_value(field: str, text: str) -> RegionValue:
    """`REGION=VALUE`, at the last equals sign. Raises ConfigError naming the field."""
    region, equals, value = text.rpartition("=")
    if not (equals and region and value):
        raise ConfigError(
            f"{field}: {text!r} is not REGION=VALUE; write for example 3=autumn.jpg or IMG_0012:120,80=0"
        )
    return RegionValue(region, value)


def parse_strength(field: str, text: str) -> tuple[str, float]:
    """`REGION=STRENGTH` with a strength in [0, 1]. Raises ConfigError."""
    region, value = parse_region_value(field, text)
    try:
        strength = float(value)
    except ValueError:
        raise ConfigError(f"{field}: {text!r}: {value!r} is no number; write for example 3=0.5") from None
    between(field, strength, 0.0, 1.0)
    return region, strength


def parse_pixel(text: str) -> tuple[float, float] | None:
    """`X,Y`, x to the right and y down in pixels of the rendered view; None for something else, such as the
    name of a mask.
    """
    match = _PIXEL_PATTERN.fullmatch(text)
    return (float(match[1]), float(match[2])) if match else None


def labels(paths: Sequence[Path]) -> tuple[str, ...]:
    """Name each reference, all different: by its file, with folders before it or a number behind where files
    agree.
    """
    for folders in range(3):
        names = []
        for p in paths:
            names.append("/".join([*(f.name for f in p.parents[:folders][::-1] if f.name), p.name]))
        if len(set(names)) == len(names):
            return tuple(names)
    plain = [p.name for p in paths]
    return tuple(
        f"{name} ({plain[:i].count(name) + 1})" if name in plain[:i] else name for i, name in enumerate(plain)
    )


def find_reference(text: str, paths: Sequence[Path]) -> int:
    """Index of a reference: by label, else path or name, else number from 0, else stem. Raises UsageError."""
    names = labels(paths)
    # What is exact comes first: a number may also be the stem of a file.
    for matches in (
        [i for i, name in enumerate(names) if text == name],
        [i for i, p in enumerate(paths) if text in (str(p), p.name)],
        [int(text)] if text.isascii() and text.isdigit() and int(text) < len(paths) else [],
        [i for i, p in enumerate(paths) if text == p.stem],
    ):
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise UsageError(
                f"reference {text!r}: {len(matches)} references are called so; use the number, from 0"
            )
    given = ", ".join(f"{i} {name}" for i, name in enumerate(names))
    raise UsageError(f"reference {text!r}: no such reference; there are {given}")


NO_MASK = Path("none")
"""Stands for the whole photograph among the masks."""


@dataclass(frozen=True, kw_only=True)
class StyleConfig(SunConfig):
    """Controls of the style. REGION and REFERENCE are explained above."""

    references: tuple[Path, ...] = ()
    """Photographs whose style the scene takes, or folders of them."""
    weights: tuple[float, ...] = ()
    """Weight of each reference, in their order, above 0; none = all alike."""
    masks: tuple[Path, ...] = ()
    """A picture for each reference, in their order: only what is white there makes style codes; `none` = all
    of it. A folder of pictures is searched by the reference's name (docs/formats.md); one is for all.
    """
    stylizer: StylizerConfig = RegionToneConfig()
    """Method that moves the scene's features."""
    clusters: int = 20
    """Local styles (codes) per reference, at least 1."""
    blend: float = 0.1
    """Share of the overall style in each local one, in [0, 1], on both sides: 0 = local, 1 = global."""
    strength: float = 1.0
    """0 leaves the scene bit for bit as it is, 1 is the full style."""
    luminance: float = 0.0
    """Share of the scene's own luminance that is kept, in [0, 1]; at 1 the references give their tints
    alone.
    """
    bold: float = 0.65
    """Strength of the paint on things that the references do not surely show, in [0, 1]: 0 = everything takes
    light alone, 0.5 = as far as the match is sure, 1 = everything is painted. Counts where `stylizer.light`
    is true. The default paints a little more than is sure.
    """
    pin: tuple[str, ...] = ()
    """REGION=REFERENCE: the region takes its style from this reference (from any of them, if pinned to
    several). For Gaussians REGION may be a place; a later place lies over those before it.
    """
    forbid: tuple[str, ...] = ()
    """REGION=REFERENCE: the region takes nothing from this reference."""
    keep: tuple[str, ...] = ()
    """REGION: the region stays as it is."""
    region_strength: tuple[str, ...] = ()
    """REGION=STRENGTH in [0, 1]: how strongly the region is restyled, times the overall strength."""
    keep_below: float | None = None
    """Regions whose best score is lower stay as they are, unless pinned; a score is a cosine, in [-1, 1].
    none = no limit.
    """
    between: Path | None = None
    """Another style file: the result lies between this style and that one, feature by feature."""
    at: float = 0.5
    """Place between the two styles, in [0, 1]: 0 = this one, 1 = the other."""

    def __post_init__(self) -> None:
        convert_fields(self)
        SunConfig.__post_init__(self)
        for name in ("blend", "strength", "luminance", "bold", "at"):
            between(name, getattr(self, name), 0.0, 1.0)
        at_least("clusters", self.clusters, 1)
        for weight in self.weights:
            at_least("weights", weight, 1e-6)
        if self.keep_below is not None:
            between("keep_below", self.keep_below, -1.0, 1.0)
        for name in ("pin", "forbid"):
            for text in getattr(self, name):
                region, _ = parse_region_value(name, text)
                if name == "pin":
                    parse_place(name, region)
        for text in self.region_strength:
            parse_strength("region_strength", text)
        for name in ("weights", "masks"):
            given = len(getattr(self, name))
            # A folder of masks, which `with_folders` replaces by what it holds.
            one_folder = name == "masks" and given == 1 and self.masks[0] != NO_MASK
            if given and self.references and given != len(self.references) and not one_folder:
                raise ConfigError(
                    f"{name}: {given} {name} for {len(self.references)} references; give one each, or none"
                )


C = TypeVar("C", bound=StyleConfig)

PRESETS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "gentle": MappingProxyType(
            {"strength": 0.9, "luminance": 0.2, "blend": 0.2, "stylizer.smoothness": 128.0}
        ),
    }
)
"""Values by dotted field of `StyleConfig`. `gentle`: safe on photographs, still clearly in the style
(docs/styles.md).
"""


def with_preset(config: C, name: str) -> C:
    """The config with the values of a preset, but for fields that its stylizer does not have.

    Raises UsageError for an unknown name.
    """
    if name not in PRESETS:
        raise UsageError(
            f"preset {name!r}: no such preset{nearest(name, list(PRESETS))}; there is {', '.join(PRESETS)}"
        )
    for path, value in PRESETS[name].items():
        slot, _, field = path.rpartition(".")
        if hasattr(getattr(config, slot) if slot else config, field):
            config = slots.replace(config, path, value)
    return config


def preset_flags(name: str) -> str:
    """Flags that a preset sets."""
    return " ".join(f"--{path.replace('_', '-')} {value:g}" for path, value in PRESETS[name].items())
