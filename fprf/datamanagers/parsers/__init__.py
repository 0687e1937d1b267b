"""Parsers of scene folders, photographs with poses: one format a file."""
