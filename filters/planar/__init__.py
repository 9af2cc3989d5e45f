"""Estimators on the planar model, state [u, v, r]."""
