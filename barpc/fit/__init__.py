"""Sensor model to RPC: the fit and its certificate."""

from __future__ import annotations

from barpc.base.options import FitOptions
from barpc.fit.certificate import Localisation, RpcFit
from barpc.fit.refit import fit_rpc, fit_rpc_points
from barpc.fit.system import Normalization

__all__ = ["FitOptions", "Localisation", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]
