"""Benchmarks of a run: speed, where time goes, time against error, memory, scaling."""
