"""A scene in the browser: `fprf view`."""
