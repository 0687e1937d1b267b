"""Every file that somebody else may hand us, mutated: each reader must answer with a value or with one line.

    for target in readers.targets(folder): outcome = fuzz(target, rounds, seed)

A mutation flips, cuts, repeats, swaps or overwrites bytes of a valid file; where it stands for text, also by words that mean
something to a parser. Draws are functions of (seed, round): a failure is found again by its number.
"""

import random
import re
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..errors import FprfError

__all__ = ["Outcome", "Target", "fuzz", "mutated"]

WHOLE_EVERY = 16
"""Rounds of which one is read to the end, where a reader of the bytes alone is known."""
WORDS = (b"NaN", b"1e400", b"-1", b"0", b"null", b"true", b"[]", b"{}", b"../../etc/passwd", b"\x00", b"\xff\xfe", b"9" * 40)
VALUES = (b"0", b"-1", b"1e300", b"1e-300", b"null", b'"x"', b"[]", b"{}", b"true", b"0.5", b"65536", b"1e999", b"123456789012")
"""What stands in the place of a number of a text."""
_NUMBER = re.compile(rb"-?\d+(\.\d+)?")
NUMBERS = tuple(struct.pack("<Q", value) for value in (0, 1, 2**28, 2**31, 2**63, 2**64 - 1))
NUMBERS += tuple(struct.pack("<d", value) for value in (0.0, -1.0, 1e300, float("nan"), float("inf")))


class Target(NamedTuple):
    """A reader and a valid file for it."""

    name: str
    file: Path
    """What is mutated; its folder holds whatever else the reader needs."""
    read: Callable[[], object]
    """To the end: a scene, a config, pixels."""
    parse: Callable[[], object] | None = None
    """The bytes alone, where what follows takes most of the time."""


class Outcome(NamedTuple):
    """What came of some rounds."""

    rounds: int
    values: int
    refusals: int
    """Errors of ours, which are of one line (`FprfError`)."""
    faults: tuple[str, ...]
    """Anything else, by round."""
    slowest: float
    """Seconds of the processor for the longest round."""
    memory: int
    """Most bytes that Python held at once in a round, where it was watched; 0 otherwise."""


def mutated(data: bytes, draw: random.Random) -> bytes:
    """The bytes with one to four harms, mostly one."""
    raw = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        at, kind = draw.randrange(len(raw) + 1), draw.randrange(9)
        if kind > 6 and (found := list(_NUMBER.finditer(raw))):
            start, stop = draw.choice(found).span()
            raw[start:stop] = draw.choice(VALUES)
        elif kind == 0 and raw:
            raw[at % len(raw)] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del raw[at:]
        elif kind == 2:
            raw[at : at + 8] = draw.choice(NUMBERS)
        elif kind == 3:
            raw[at:at] = draw.choice(WORDS)
        elif kind == 4:
            raw[at : at + draw.randint(1, 9)] = draw.choice(WORDS)
        elif kind == 5:
            raw[at:at] = raw[at : at + draw.randint(1, 64)] * draw.randint(1, 4)
        else:
            del raw[at : at + draw.randint(1, 64)]
    return bytes(raw)


def fuzz(target: Target, rounds: int, seed: int, *, first: int = 0, watch_memory: bool = False, quick: bool = False) -> Outcome:
    """Read `rounds` mutations of the target's file, from number `first` on; the file is put back at the end.

    `quick` ones go to the reader of the bytes where there is one, and each sixteenth through to the end.
    """
    whole = target.file.read_bytes()
    values = refusals = memory = 0
    slowest, faults = 0.0, []
    try:
        for number in range(first, first + rounds):
            draw = random.Random(f"{target.name} {seed} {number}")  # nosec B311  # no secrets
            target.file.write_bytes(mutated(whole, draw))
            if watch_memory:
                tracemalloc.start()
            start = time.process_time()
            try:
                (target.parse if quick and target.parse and number % WHOLE_EVERY else target.read)()
                values += 1
            except FprfError:
                refusals += 1
            except Exception as error:
                faults.append(f"{number}: {error!r}"[:300])
            slowest = max(slowest, time.process_time() - start)
            if watch_memory:
                memory = max(memory, tracemalloc.get_traced_memory()[1])
                tracemalloc.stop()
    finally:
        target.file.write_bytes(whole)
    return Outcome(rounds, values, refusals, tuple(faults), slowest, memory)
