"""Sensor model to RPC: the fit and its certificate."""

from __future__ import annotations

from barpc.fit.options import FitOptions, Normalization
from barpc.fit.rpc import RpcFit, fit_rpc, fit_rpc_points

__all__ = ["FitOptions", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]
