"""Wavefront maps, the modes that describe their changes, and priors on those."""
