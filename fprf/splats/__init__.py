"""Scenes of 3D Gaussians: the Gaussians themselves, their files, and how captures of others are looked at and
restyled.
"""
