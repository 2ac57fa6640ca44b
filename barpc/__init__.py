"""barpc: bundle adjustment of satellite images with RPC cameras.

Images become tie points, tie points become corrections, corrections compose into P_BA, and P_BA is fitted into an RPC.
The names below are the public ones; they are imported when first used, so that ``import barpc`` costs nothing.
A function is called as the verb of the command line; `barpc.fit`, `dsm`, `export` and `report` are verbs, and
folders for `from barpc.fit import ...` alone.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as of `typing`, whose import is most of what this one would cost

__version__ = "0.5.0"

_PUBLIC_MODULES = {
    "barpc.verbs.runs": "adjust check dsm export match open_run plan report verify",
    "barpc.verbs.points": "localize project triangulate",
    "barpc.verbs.converting": "convert",
    "barpc.verbs.describe": "info",
    "barpc.verbs.fitting": "fit",
    "barpc.verbs.orthoimages": "ortho",
    "barpc.pipeline.calibrate": "calibrate",
    "barpc.pipeline": "AdjustResult OpenedRun Plan",
    "barpc.cameras": "open_camera",
    "barpc.sensor": "SensorModel",
    "barpc.sensor.rpc": "RPC",
    "barpc.sensor.pushbroom": "Pushbroom",
    "barpc.sensor.sentinel1": "RangeDoppler",
    "barpc.sensor.corrected": "Correction Corrected",
    "barpc.sensor.image_corrections": "RowSpline Splined",
    "barpc.scene": "View Tracks GroundPoints",
    "barpc.rpcio": "read_rpc write_rpc",
    "barpc.fit": "RpcFit fit_rpc fit_rpc_points",
    "barpc.base.options": "RunOptions TieOptions AdjustOptions FitOptions",
    "barpc.base.verb_options": "DsmOptions",
    "barpc.base.errors": "BarpcError BarpcWarning ReservationError",
}
_PUBLIC = {name: module for module, names in _PUBLIC_MODULES.items() for name in names.split()}

if TYPE_CHECKING:
    from typing import Any

    from barpc.base.errors import BarpcError as BarpcError
    from barpc.base.errors import BarpcWarning as BarpcWarning
    from barpc.base.errors import ReservationError as ReservationError
    from barpc.base.options import AdjustOptions as AdjustOptions
    from barpc.base.options import FitOptions as FitOptions
    from barpc.base.options import RunOptions as RunOptions
    from barpc.base.options import TieOptions as TieOptions
    from barpc.base.verb_options import DsmOptions as DsmOptions
    from barpc.cameras import open_camera as open_camera
    from barpc.fit import RpcFit as RpcFit
    from barpc.fit import fit_rpc as fit_rpc
    from barpc.fit import fit_rpc_points as fit_rpc_points
    from barpc.pipeline import AdjustResult as AdjustResult
    from barpc.pipeline import OpenedRun as OpenedRun
    from barpc.pipeline import Plan as Plan
    from barpc.pipeline.calibrate import calibrate as calibrate
    from barpc.rpcio import read_rpc as read_rpc
    from barpc.rpcio import write_rpc as write_rpc
    from barpc.scene import GroundPoints as GroundPoints
    from barpc.scene import Tracks as Tracks
    from barpc.scene import View as View
    from barpc.sensor import SensorModel as SensorModel
    from barpc.sensor.corrected import Corrected as Corrected
    from barpc.sensor.corrected import Correction as Correction
    from barpc.sensor.image_corrections import RowSpline as RowSpline
    from barpc.sensor.image_corrections import Splined as Splined
    from barpc.sensor.pushbroom import Pushbroom as Pushbroom
    from barpc.sensor.rpc import RPC as RPC
    from barpc.sensor.sentinel1 import RangeDoppler as RangeDoppler
    from barpc.verbs.converting import convert as convert
    from barpc.verbs.describe import info as info
    from barpc.verbs.fitting import fit as fit
    from barpc.verbs.orthoimages import ortho as ortho
    from barpc.verbs.points import localize as localize
    from barpc.verbs.points import project as project
    from barpc.verbs.points import triangulate as triangulate
    from barpc.verbs.runs import adjust as adjust
    from barpc.verbs.runs import check as check
    from barpc.verbs.runs import dsm as dsm
    from barpc.verbs.runs import export as export
    from barpc.verbs.runs import match as match
    from barpc.verbs.runs import open_run as open_run
    from barpc.verbs.runs import plan as plan
    from barpc.verbs.runs import report as report
    from barpc.verbs.runs import verify as verify
__all__ = ["__version__", *sorted(_PUBLIC)]
for _folder in ("dsm", "export", "fit", "report"):  # its first import takes the name, its verb's from here on
    import_module(f"{__name__}.{_folder}")
    globals().pop(_folder, None)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'barpc' has no attribute {name!r}")
    found = getattr(import_module(_PUBLIC[name]), name)
    if type(found) is type(__getattr__):
        found = import_module("barpc.verbs.python").of_python(found)
    return globals().setdefault(name, found)


def __dir__() -> list[str]:
    return sorted(__all__)
