"""Sensor model to RPC: the fit and its certificate."""

from __future__ import annotations

from barpc.fit.certified import RpcFit
from barpc.fit.localisation import Localisation
from barpc.fit.precision import Normalization
from barpc.fit.refit import fit_rpc, fit_rpc_points
from barpc.options import FitOptions

__all__ = ["FitOptions", "Localisation", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]
