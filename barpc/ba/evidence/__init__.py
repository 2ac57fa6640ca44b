"""Residuals of tie points: scans for intervals, periods and correlated noise, and the evidence of a mixture."""
