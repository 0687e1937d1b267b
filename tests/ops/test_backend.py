"""The switch between compiled kernels and their plain forms."""

import threading

import torch

from fprf.ops import backend, dense, march, triplane_numba


def test_plain_forms_alone_within_the_block() -> None:
    x, table = torch.zeros(4, 3), torch.zeros(12, 8)
    with torch.no_grad():
        for _ in range(2):
            assert backend.compiled() and dense.usable(x) and march.usable(x) and triplane_numba.usable(x, table)
            with backend.plain():
                assert not (backend.compiled() or dense.usable(x) or march.usable(x) or triplane_numba.usable(x, table))
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


def test_the_block_ends_with_an_error() -> None:
    try:
        with backend.plain():
            raise ValueError
    except ValueError:
        assert backend.compiled()
