"""Files that are written completely or not at all, files with checksums, and safe reading."""
