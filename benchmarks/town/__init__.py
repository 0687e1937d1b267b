"""A procedural street with exact depth, labels and palettes: true answers for the tests and the benchmarks,
without a download.

World metres, x along the street, y across it, z up; the ground is z = 0. Everything is a pure function of a
seed; a palette changes colours and light but neither geometry nor labels; colour is a function of the surface
point alone (the sky's of the direction).
"""

from .write import main as main
