"""TF32 holds for a block and is put back, whatever happens in it."""

import pytest
import torch

from fprf.ops.precision import tf32


@pytest.mark.parametrize("enabled", [True, False])
def test_tf32_is_put_back_after_an_error(enabled: bool) -> None:
    with pytest.raises(KeyError), tf32(enabled):
        assert torch.get_float32_matmul_precision() == ("high" if enabled else "highest")
        raise KeyError
    assert torch.get_float32_matmul_precision() == "highest"
