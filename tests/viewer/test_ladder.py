import itertools

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fprf.viewer.ladder import Speed, rungs


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=60)
@given(st.integers(1, 4096), st.integers(1, 4096))
def test_rungs_double_up_to_the_very_size(width: int, height: int) -> None:
    found = rungs((width, height))
    assert found[-1] == (width, height)
    assert found == sorted(found) and all(min(size) >= 1 for size in found)
    for small, large in itertools.pairwise(found):
        assert abs(small[0] - large[0] / 2) <= 1 and abs(small[1] - large[1] / 2) <= 1
    assert max(found[0]) < 33 or len(found) == 1


def test_a_slow_machine_begins_coarse_and_a_fast_one_sharp() -> None:
    sizes = rungs((640, 480))
    assert Speed(1e-9).first(sizes) == len(sizes) - 1
    assert Speed(1.0).first(sizes) == 0
    middle = Speed(1e-5).first(sizes)  # 0.1 s are 10 000 pixels
    assert sizes[middle] == (80, 60)


def test_speed_learns_and_forgets() -> None:
    speed = Speed(1e-5)
    for _ in range(40):
        speed.learn(1000, 1.0)
    assert abs(speed.seconds - 1e-3) < 1e-6
    speed.learn(0, 5.0)
    assert abs(speed.seconds - 1e-3) < 1e-6
    for _ in range(40):
        speed.learn(1000, 0.001)
    assert speed.seconds < 2e-6
