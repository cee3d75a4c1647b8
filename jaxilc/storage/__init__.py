"""Files that are whole or not there, files with checksums, and careful reading of other files."""
