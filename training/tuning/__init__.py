"""Noise settings of filters, found in logs."""
