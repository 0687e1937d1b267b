"""What training with a config lacks on this machine, all of it at once, each with what cures it."""

from ..config import TrainConfig
from ..datamanagers.parsers.config import recognise
from ..errors import DataError, PluginError, WeightsError
from ..plugins.config import Need
from ..plugins.decoders.remedy import pretrain_line
from ..plugins.slots import slots

__all__ = ["decoder_needs", "plugin_needs", "scene_needs"]


def plugin_needs(config: TrainConfig) -> list[Need]:
    """The needs of all plug-ins of a config, each opened by the path of its slot.

    Raises PluginError where a plug-in cannot say what it needs.
    """
    found = []
    for slot in slots(config):
        try:
            needs = () if slot.value is None else tuple(slot.value.needs())
        except Exception as error:  # a stranger's
            raise PluginError(f"{slot.path}: cannot say what it needs ({type(error).__name__}: {error})") from error
        found += [need._replace(what=f"{slot.path}: {need.what}") for need in needs]
    return found


def decoder_needs(config: TrainConfig) -> list[Need]:
    """A decoder for the content encoder; its weights are read, so ask where the encoder itself lacks nothing."""
    try:
        encoder = config.content.encoder.build()
        config.content.decoder.build(encoder=encoder.identity, channels=encoder.channels, seed=config.seed)
    except WeightsError as fault:
        return [Need(f"content.decoder: {fault}", pretrain_line(config.content.encoder))]
    return []


def scene_needs(config: TrainConfig) -> list[Need]:
    """A scene folder that some parser reads."""
    if config.data is None:
        return [Need("no scene is named", "give --data FOLDER, or --data town for the embedded scene")]
    if config.datamanager.parser is not None:
        return []
    try:
        recognise(config.data)
    except DataError as fault:
        return [Need("the scene", str(fault))]
    return []
