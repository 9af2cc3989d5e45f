"""Estimators whose axle forces are states that only noise drives."""
