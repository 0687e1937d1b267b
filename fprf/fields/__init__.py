"""What a scene is made of: planes, content, semantics, blocks."""
