"""Sensor model to RPC: the fit and its certificate. The names below are imported when first used."""

from importlib import import_module

TYPE_CHECKING = False  # as of `typing`, whose import is most of what `import barpc` would cost

if TYPE_CHECKING:
    from typing import Any

    from barpc.base.options import FitOptions
    from barpc.fit.certificate import Localisation, RpcFit
    from barpc.fit.refit import fit_rpc, fit_rpc_points
    from barpc.fit.system import Normalization

_MODULES = {
    "FitOptions": "barpc.base.options",
    **dict.fromkeys(("Localisation", "RpcFit"), "barpc.fit.certificate"),
    **dict.fromkeys(("fit_rpc", "fit_rpc_points"), "barpc.fit.refit"),
    "Normalization": "barpc.fit.system",
}
__all__ = ["FitOptions", "Localisation", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]


def __getattr__(name: str) -> "Any":
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
