"""Scenes, images, features and batches."""
