"""Fields of a scene: planes, content, semantics."""
