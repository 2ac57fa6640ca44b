"""Rasters opened safely; terrain heights and geoids."""
