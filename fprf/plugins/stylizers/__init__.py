"""Built-in stylizers. To add one: a config in config.py, a class in a file here, a line in pyproject.toml."""
