"""A scene in the browser: `fprf view`. Everything but `frontend` works, and is tested, without viser."""
