"""The embedded scene: a procedural street with exact depth, labels and palettes.

Feeds the tests and the benchmarks with true answers, and needs no download. World metres, x along the
street, y across it, z up; the ground is z = 0. Everything is a pure function of a seed; a palette changes colours and
light but neither geometry nor labels; colour is a function of the surface point alone (the sky's of the direction).
"""
