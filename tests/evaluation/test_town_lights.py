import torch

from fprf.evaluation.town_truth import PARTS, photograph, places, shows

SIZE = (48, 36)


def test_three_references_share_the_work() -> None:
    found = places((7, 11, 13), SIZE)
    assert [place.name for place in found["three"]] == list(PARTS)
    assert [place.seed for place in found["three"]] == [7, 11, 13] and found["one"][0].seed == 7
    seen = {place.name: photograph(place, "night") for place in found["three"]}
    for part in PARTS:
        own = shows(seen[part].classes.numpy(), part)
        assert own > 0.2
    assert shows(seen["facades"].classes.numpy(), "facades") > shows(seen["street"].classes.numpy(), "facades")


def test_light_changes_no_class() -> None:
    (place,) = places((7, 11, 13), SIZE)["one"]
    day, night = photograph(place, "day"), photograph(place, "night")
    assert torch.equal(day.classes, night.classes) and day.image.shape == (36, 48, 3)
    assert float(night.image.mean()) < float(day.image.mean())
    assert (day.name, night.name) == ("day-street", "night-street")
