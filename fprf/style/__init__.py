"""Dictionaries, clusters and statistics: the mathematics of a style."""
