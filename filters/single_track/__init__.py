"""Estimators on the single track with tyres, state [yaw_rate, beta]."""
