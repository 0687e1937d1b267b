"""Cameras, spaces, step functions and compositing."""
