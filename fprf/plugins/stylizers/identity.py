"""The stylizer that changes nothing."""

from typing import Annotated

from torch import Tensor

from ...interfaces import Stylizer
from ...style.dictionary import StyleDictionary, code_odds
from ...types import Want

__all__ = ["IdentityStylizer"]


class IdentityStylizer(Stylizer):
    """Content goes through bit for bit."""

    odds: Tensor

    def __init__(self, dictionary: StyleDictionary) -> None:
        super().__init__()
        self.register_buffer("odds", code_odds(dictionary).float())

    @property
    def needs(self) -> Want:
        """Content alone."""
        return Want.CONTENT

    def forward(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Annotated[Tensor, "N C"]:
        """The content itself."""
        return content

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """Every point alike: the codes' shares of the references."""
        return self.odds.expand(len(semantic), -1)
