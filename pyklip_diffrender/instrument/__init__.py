"""JWST and NIRCam from embedded tables: mirror, masks, filters, `nircam_coronagraph`."""
