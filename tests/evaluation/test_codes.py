import pytest
import torch
from tiny_world import World

from fprf.errors import DataError
from fprf.evaluation.single_image import encoded
from fprf.evaluation.town_truth import Reference, code_classes, match_rates, photograph, places
from fprf.style.dictionary import Reference as Samples
from fprf.style.dictionary import build_dictionary
from fprf.town.surface import CAR, SKY, WINDOW


def reference(classes: torch.Tensor) -> Reference:
    return Reference("some", torch.zeros(*classes.shape, 3), classes)


def test_classes_that_no_reference_shows_do_not_count() -> None:
    truth = torch.tensor([[SKY, SKY, CAR, CAR]])
    assert match_rates([torch.full_like(truth, SKY)], [truth], [reference(torch.tensor([[SKY]]))]).match == 1
    assert match_rates([truth], [truth], [reference(torch.tensor([[WINDOW]]))]).match is None
    without = torch.full_like(truth, -1)  # codes of no class are wrong, of no kind too
    assert tuple(match_rates([without], [truth], [reference(truth)])) == (0, None, 0, 0)


def test_codes_are_of_the_class_that_they_were_made_of(world: World) -> None:
    trained = world.load()
    encoders = trained.encoders()
    assert encoders.semantic is not None
    guided = trained.config.datamanager.guided
    shown = photograph(places((7, 11, 13), (96, 72))["one"][0], "autumn")
    semantic = encoded(shown.image, encoders.semantic, guided, encoders.basis)
    dictionary = build_dictionary([Samples("street", semantic, semantic)], clusters=8, seed=0)
    classes = code_classes(dictionary, {"street": shown}, encoders, guided)
    nearest = torch.cdist(semantic, dictionary.keys).argmin(1)
    right = (classes[nearest] == shown.classes.flatten()).double().mean()
    assert SKY in classes.tolist() and float(right) > 0.5, "chance is a twelfth, one class alone a third"
    with pytest.raises(DataError, match="no semantics"):
        code_classes(dictionary, {"street": shown}, encoders._replace(semantic=None), guided)
