"""Estimators of the sideslip angle: algorithms applied to the models."""
