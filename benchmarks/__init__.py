"""Measurements that no user of the installed package runs: `python -m benchmarks NAME [flags]` in a clone of
the repository.
"""
