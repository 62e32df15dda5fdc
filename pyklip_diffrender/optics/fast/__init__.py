"""A faster path through a coronagraph with one compact occulter, with the same results."""
