"""Files that are whole or not there, files with checksums, and files from outside that are read
with care.
"""
