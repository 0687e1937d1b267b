"""Training terms that packages add."""
