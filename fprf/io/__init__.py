"""Files that people look at: pictures, videos and maps. Everything is written whole or not at all."""
