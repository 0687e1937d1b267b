"""Fields of a scene: planes, content, semantics, layouts of blocks."""
