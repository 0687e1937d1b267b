"""Benchmarks with true answers, the paper's tables, and the judging of other systems' frames."""
