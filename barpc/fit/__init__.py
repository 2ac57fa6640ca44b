"""Sensor model to RPC: the fit and its certificate."""

from __future__ import annotations

from barpc.fit.certificate import Localisation, RpcFit
from barpc.fit.refit import fit_rpc, fit_rpc_points
from barpc.fit.system import Normalization
from barpc.options import FitOptions

__all__ = ["FitOptions", "Localisation", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]
