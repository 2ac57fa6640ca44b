"""Sensor model to RPC: the fit and its certificate. The names below are imported when first used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from barpc.base import used_later
from barpc.base.options import FitOptions

if TYPE_CHECKING:
    from barpc.fit.certificate import Localisation, RpcFit
    from barpc.fit.refit import fit_rpc, fit_rpc_points
    from barpc.fit.system import Normalization

__all__ = ["FitOptions", "Localisation", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]
__getattr__ = used_later(
    __name__,
    {
        **dict.fromkeys(("Localisation", "RpcFit"), "certificate"),
        **dict.fromkeys(("fit_rpc", "fit_rpc_points"), "refit"),
        "Normalization": "system",
    },
)
