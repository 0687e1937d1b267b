"""Files that people look at: pictures, videos, maps and the gallery. Everything is written whole or not at all."""
