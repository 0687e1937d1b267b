from typing import Any

from fprf.reconstruction.scene_folder import dropped_images


class Matches:
    """Features and partners of images by name."""

    def __init__(self, **known: tuple[int, int]) -> None:
        self.known = known

    def features_of(self, name: str) -> int:
        return self.known[name][0]

    def partners(self, name: str, least: int) -> int:
        assert least > 0
        return self.known[name][1]


FOUND = Matches(a=(900, 3), b=(900, 2), bare=(0, 0), lonely=(50, 0), apart=(80, 1), odd=(70, 4))
MODELS: list[dict[str, Any]] = [
    {"images": ["a", "b"], "points": 10, "error_pixels": 0.5, "track_length": 3.0},
    {"images": ["apart", "elsewhere"], "points": 4, "error_pixels": 0.7, "track_length": 2.0},
]
STATE = {
    "source": "/photos",
    "images": dict.fromkeys(["a", "apart", "b", "bare", "lonely", "odd"]),
    "dropped": {"broken.jpg": "the JPEG is truncated"},
    "seconds": {"features": 1.5},
}


def test_every_image_has_its_reason() -> None:
    found = dropped_images(list(STATE["images"]), STATE["dropped"], FOUND, MODELS)
    assert [(drop.image, drop.step) for drop in found] == [
        ("broken.jpg", "choosing"),
        ("bare", "features"),
        ("lonely", "matching"),
        ("apart", "mapping"),
        ("odd", "mapping"),
    ]
    reasons = {drop.image: drop.reason for drop in found}
    assert reasons["broken.jpg"] == "the JPEG is truncated" and "no other image" in reasons["lonely"]
    assert reasons["apart"] == "in part 2 (2 images), apart from the rest; take views in between"
    assert reasons["odd"] == "fits 4 images, but no pose was found for it"
