"""Estimators made of estimators: blends, cross-combination, banks of models."""
