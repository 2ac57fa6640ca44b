"""Sensor model to RPC: the fit and its certificate. The names below are imported when first used."""

from barpc.base import used_later

TYPE_CHECKING = False  # as of `typing`, whose import is most of what `import barpc` would cost

if TYPE_CHECKING:
    from barpc.base.options import FitOptions
    from barpc.fit.certificate import RpcFit
    from barpc.fit.given import fit_rpc_points
    from barpc.fit.refit import fit_rpc
    from barpc.fit.system import Normalization

_MODULES = {
    "FitOptions": "barpc.base.options",
    "RpcFit": "barpc.fit.certificate",
    "fit_rpc": "barpc.fit.refit",
    "fit_rpc_points": "barpc.fit.given",
    "Normalization": "barpc.fit.system",
}
__all__ = ["FitOptions", "Normalization", "RpcFit", "fit_rpc", "fit_rpc_points"]
__getattr__ = used_later(__name__, _MODULES)
