"""Switches for a block of code: plain forms in place of compiled kernels, TF32."""

import threading

import pytest
import torch

from fprf.ops import backend, dense, triplane
from fprf.ops.backend import float32_convolutions, tf32


def test_plain_forms_alone_within_the_block() -> None:
    x = torch.zeros(4, 3)
    table = torch.zeros(12, 8)
    with torch.no_grad():
        for _ in range(2):
            assert backend.compiled() and dense.usable(x) and triplane.usable(x, table)
            with backend.plain():
                assert not (backend.compiled() or dense.usable(x) or triplane.usable(x, table))
                with backend.plain():
                    assert not backend.compiled()
                assert not backend.compiled()


def test_other_threads_go_on() -> None:
    found: list[bool] = []
    with backend.plain():
        thread = threading.Thread(target=lambda: found.append(backend.compiled()))
        thread.start()
        thread.join()
    assert found == [True] and backend.compiled()


@pytest.mark.parametrize("enabled", [True, False])
def test_tf32_is_put_back_after_an_error(enabled: bool) -> None:
    with pytest.raises(KeyError), tf32(enabled):
        assert torch.get_float32_matmul_precision() == ("high" if enabled else "highest")
        raise KeyError
    assert torch.get_float32_matmul_precision() == "highest"


def test_convolutions_are_in_float32_within_the_block() -> None:
    before = torch.backends.cudnn.conv.fp32_precision
    with float32_convolutions(torch.device("cpu")):
        assert torch.backends.cudnn.conv.fp32_precision == before
    with pytest.raises(KeyError), float32_convolutions(torch.device("cuda:0")):
        assert torch.backends.cudnn.conv.fp32_precision == "ieee"
        raise KeyError
    assert torch.backends.cudnn.conv.fp32_precision == before
