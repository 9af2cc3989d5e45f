"""Formats of logs: one file each, named in one line of the table."""
