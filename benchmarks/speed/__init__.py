"""Measure durations and errors of this package and of others in the same run.

A row is a task (one image, one image with its derivative, a refinement ...); its cases are ways of
performing it. All cases of a row are timed in turns, in one process after a warm-up, and the
shortest duration counts. Errors are those of the timed results.
"""
