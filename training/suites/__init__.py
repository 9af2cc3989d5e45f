"""Benchmarks: accuracy and speed of everything on fixed sets of logs."""
