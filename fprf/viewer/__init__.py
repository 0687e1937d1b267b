"""A scene in the browser: `fprf view`. Everything but `server` and `panel` works, and is tested, without viser."""
