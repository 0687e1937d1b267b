"""The decoder that a config asks for, or the command that makes it."""

from ..config import TrainConfig
from ..errors import WeightsError
from ..interfaces import Decoder
from ..plugins.decoders.remedy import pretrain_line

__all__ = ["build_decoder"]


def build_decoder(config: TrainConfig, *, encoder: str, channels: int) -> Decoder:
    """The decoder of the content encoder, by the encoder's identity.

    Raises WeightsError where there is none or it belongs to another encoder, with the line that makes the right one.
    """
    try:
        return config.content.decoder.build(encoder=encoder, channels=channels, seed=config.seed + 3)
    except WeightsError as error:
        line = pretrain_line(config.content.encoder)
        raise WeightsError(f"{error}; `{line}` makes its decoder, --content.decoder.weights FILE names it") from error
