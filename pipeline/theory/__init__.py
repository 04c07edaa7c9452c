"""What follows from a loop by theory, a module each: boundary, settling and overshoot, energy, passivity, optimum.

Walls are arguments, normalised as in `pipeline.loop`; `cases` makes the documents that users read.
"""
