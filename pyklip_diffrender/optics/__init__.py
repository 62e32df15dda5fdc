"""Fourier optics of a coronagraph in torch: pupils, masks, detector, `OpticalSystem`."""
