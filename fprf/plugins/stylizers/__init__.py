"""Built-in stylizers."""
