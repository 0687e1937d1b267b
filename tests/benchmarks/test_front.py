from hypothesis import given
from hypothesis import strategies as st

from benchmarks.pareto import Point, front
from fprf.evaluation.report import Spread


def point(seconds: float, rms: float | None, psnr: float | None = None, value: str = "x") -> Point:
    return Point(
        knob="k", value=value, seconds=Spread(seconds, seconds, seconds, 1), rays_per_second=1 / seconds, largest=rms, rms=rms,
        psnr=psnr,
    )  # fmt: skip


POINTS = st.lists(
    st.builds(point, st.sampled_from([1.0, 2.0, 3.0, 4.0]), st.sampled_from([None, 0.0, 0.1, 0.2, 0.3])), max_size=12
)


@given(POINTS)
def test_nothing_beats_a_point_on_the_front_and_something_equals_or_beats_every_other(points: list[Point]) -> None:
    chosen = front(points, lambda p: p.rms)

    def beats(a: Point, b: Point) -> bool:
        assert a.rms is not None and b.rms is not None
        better = a.seconds.median < b.seconds.median or a.rms < b.rms
        return a.seconds.median <= b.seconds.median and a.rms <= b.rms and better

    known = [p for p in points if p.rms is not None]
    for p in chosen:
        assert not any(beats(other, p) for other in known)
    for p in known:
        same = [c for c in chosen if (c.seconds.median, c.rms) == (p.seconds.median, p.rms)]
        assert same or any(beats(c, p) for c in chosen)


@given(POINTS)
def test_the_front_goes_from_fast_to_exact(points: list[Point]) -> None:
    chosen = front(points, lambda p: p.rms)
    times = [p.seconds.median for p in chosen]
    errors = [p.rms for p in chosen]
    assert times == sorted(set(times)) and errors == sorted(set(errors), key=lambda e: -(e or 0.0))
