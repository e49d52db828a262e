"""Minari datasets, pictures and videos on disk, read and written."""
