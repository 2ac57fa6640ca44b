"""Files of points: correspondences, GCPs, tie points.

Plain readers, one module a kind: `tables` (ground and image points that an RPC is fitted to).
"""

from __future__ import annotations
