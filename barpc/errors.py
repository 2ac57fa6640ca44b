"""Every error that barpc raises on purpose.

::

    BarpcError
      RpcError(ValueError)        a camera model cannot be used (not finite, zero scale, wrong shape)
        RpcFormatError            a file is not an RPC file that barpc reads
      ImageError(OSError)         a raster cannot be read, or has no RPC
      TiePointError               too few tie points
        DisconnectedError         the views fall into groups that share no tie point
      AdjustError                 the adjustment has no usable solution
      FitError                    a fitted RPC does not reach the tolerance
      InputError(ValueError)      options or side files that contradict each other or do not parse
      OutputError(OSError)        a result cannot be written
    BarpcWarning(UserWarning)     a dropped view, extrapolation beyond the RPC's altitude range, ...

A message is one line that says which file or view, what was found, and what to do.
"""

from __future__ import annotations

from collections.abc import Sequence

_LONGEST = 1500  # characters of a message


class BarpcError(Exception):
    """Base of all errors that barpc raises on purpose."""

    def __str__(self) -> str:
        """One printable line of bounded length, whatever a damaged file has put into the message."""
        text = super().__str__()
        if len(text) > _LONGEST:
            text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class RpcError(BarpcError, ValueError):
    """A camera model cannot be used: a coefficient is not finite, a scale is zero, a shape is wrong."""


class RpcFormatError(RpcError):
    """A file is not an RPC file that barpc reads."""


class ImageError(BarpcError, OSError):
    """A raster cannot be read, or carries no RPC."""


class TiePointError(BarpcError):
    """Too few tie points between views."""


class DisconnectedError(TiePointError):
    """The views fall into groups that share no tie point.

    Attributes
    ----------
    groups : tuple of tuple of str
        View names, one tuple a connected group, the largest first.
    """

    def __init__(self, message: str, groups: Sequence[Sequence[str]] = ()) -> None:
        super().__init__(message)
        self.groups = tuple(tuple(group) for group in groups)


class AdjustError(BarpcError):
    """The adjustment has no usable solution."""


class FitError(BarpcError):
    """A fitted RPC does not reach the tolerance that was asked for."""


class InputError(BarpcError, ValueError):
    """Options or side files (GCPs, tie points, AOI, DEM) contradict each other or do not parse."""


class OutputError(BarpcError, OSError):
    """A result cannot be written: it exists already, the disk is full, the folder is read-only."""


class BarpcWarning(UserWarning):
    """Something the user should know that does not stop the run."""
