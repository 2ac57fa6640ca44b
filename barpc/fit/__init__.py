"""Sensor model to RPC: the fit and its certificate."""
