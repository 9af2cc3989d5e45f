"""Arithmetic that filters of several models share."""
