"""Programs that maintainers run in a clone."""
