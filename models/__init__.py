"""Equations of vehicle motion and of tyres, shared by every filter and the simulation."""
