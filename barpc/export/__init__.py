"""Finished runs in the words of other tools: Sat-NeRF, COLMAP, stereo pipelines, catalogues (`targets.TARGETS`)."""
