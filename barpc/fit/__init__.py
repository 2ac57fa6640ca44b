"""Sensor model to RPC: the fit and its certificate."""

from __future__ import annotations

from barpc.fit.localisation import Localisation
from barpc.fit.precision import Normalization
from barpc.fit.result import RpcFit
from barpc.fit.rpc import fit_rpc, fit_rpc_points
from barpc.options import FitOptions

__all__ = ["FitOptions", "Localisation", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]
