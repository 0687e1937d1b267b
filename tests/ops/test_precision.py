"""Lower precision holds for a block and is put back, whatever happens in it."""

import pytest
import torch

from fprf.ops.precision import lowered

CUDA = torch.device("cuda:0")


def test_tf32_is_put_back_after_an_error() -> None:
    before = torch.get_float32_matmul_precision()
    with pytest.raises(KeyError), lowered("tf32", CUDA):
        assert torch.get_float32_matmul_precision() == "high"
        raise KeyError
    assert torch.get_float32_matmul_precision() == before == "highest"


@pytest.mark.parametrize("precision", ["float32", "tf32", "bfloat16"])
def test_nothing_is_lowered_on_the_cpu(precision: str) -> None:
    x = torch.full((4, 4), 1.001)
    with lowered(precision, torch.device("cpu")):  # type: ignore[arg-type]
        assert torch.get_float32_matmul_precision() == "highest"
        assert torch.equal(x @ x, (x.double() @ x.double()).float()) and (x @ x).dtype == torch.float32
