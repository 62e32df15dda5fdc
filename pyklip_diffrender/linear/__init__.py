"""The linear model of a fit: derivatives of the image, and the algebra of marginalisation."""
