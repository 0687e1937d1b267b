"""A trained scene, plain or restyled, as files that other programs open."""
