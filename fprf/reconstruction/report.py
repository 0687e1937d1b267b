"""What came of every image: which have a pose, which were dropped where, and why."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

__all__ = ["Drop", "Found", "dropped", "report", "summary"]

_LEAST = 15
"""Verified matches from which on COLMAP takes two images for neighbours."""


class Found(Protocol):
    """What is known of matches (`database.Tables`)."""

    def features_of(self, name: str) -> int:
        """Features found in an image."""

    def partners(self, name: str, least: int) -> int:
        """Images that share at least `least` matches with it."""


class Drop(NamedTuple):
    """An image that the scene goes without."""

    image: str
    step: str
    """choosing, features, matching or mapping: where it was lost."""
    reason: str


def dropped(names: Sequence[str], unused: Mapping[str, str], found: Found, models: Sequence[Mapping[str, Any]]) -> list[Drop]:
    """Every image without a pose in the first of the `models`, in the order of the steps."""
    posed = set(models[0]["images"]) if models else set()
    drops = [Drop(name, "choosing", reason) for name, reason in unused.items()]
    lost = [_lost(name, found, models) for name in names if name not in posed]
    order = ("features", "matching", "mapping")
    return drops + sorted(lost, key=lambda drop: order.index(drop.step))


def _lost(name: str, found: Found, models: Sequence[Mapping[str, Any]]) -> Drop:
    features, partners = found.features_of(name), found.partners(name, _LEAST)
    if not features:
        return Drop(name, "features", "nothing with texture in it, or COLMAP cannot decode it")
    if not partners:
        return Drop(name, "matching", f"{features} features, but it fits no other image; take views in between")
    for number, model in enumerate(models[1:], 2):
        if name in model["images"]:
            size = len(model["images"])
            return Drop(name, "mapping", f"in part {number} ({size} images), apart from the rest; take views in between")
    return Drop(name, "mapping", f"fits {partners} images, but no pose was found for it")


def report(
    state: Mapping[str, Any], matching: str, found: Found, models: Sequence[Mapping[str, Any]], version: str
) -> dict[str, Any]:
    """The content of process.json. `state` is that of `place.State`, as a mapping."""
    images = state["images"]
    drops = dropped(list(images), state["dropped"], found, models)
    main = models[0] if models else {"images": [], "points": 0, "error_pixels": None, "track_length": None}
    return {
        "format": 1,
        "fprf": version,
        "source": state["source"],
        "images": {"given": len(images) + len(state["dropped"]), "used": len(images), "posed": len(main["images"])},
        "points": main["points"],
        "error_pixels": main["error_pixels"],
        "track_length": main["track_length"],
        "parts": [len(model["images"]) for model in models],
        "matching": matching,
        "step_seconds": dict(state["seconds"]),
        "dropped": [drop._asdict() for drop in drops],
    }


def summary(content: Mapping[str, Any], most: int = 12) -> list[tuple[str, str, str]]:
    """Rows of (step, image, reason) for a table; a step with more than `most` images is told as a number."""
    rows: list[tuple[str, str, str]] = []
    many = Counter(drop["step"] for drop in content["dropped"])
    told = set()
    for drop in content["dropped"]:
        step = drop["step"]
        if many[step] <= most:
            rows.append((step, drop["image"], drop["reason"]))
        elif step not in told:
            told.add(step)
            rows.append((step, f"{many[step]} images", f"for example {drop['image']}: {drop['reason']}"))
    return rows
