"""What follows from a loop by theory: limits, transients, energies, poles, passivity, optima, maps; a module each.

Walls are arguments, normalised as in `pipeline.loop`; `cases` makes the documents that users read.
"""
