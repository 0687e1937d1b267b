"""Distillation of the encoders that ship: `python -m tools.distil content|semantic`."""
