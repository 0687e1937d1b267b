"""Model, losses, training and checkpoints."""
