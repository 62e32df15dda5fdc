"""Sixty deliberate breakages of the package, and whether the tests notice them."""
