"""Theory of a linear loop, one module per question: crossings, boundary, responses, energy, passivity, optimum.

Walls are arguments, normalised as in `pipeline.loop`. `cases` computes the results that command line, service and
Python share.

The domain of every entry is that of `NormalisedLoop`: delays up to 256 samples, gamma and delta from 0, one vibration
mode, a lag, and a linear filter of up to 96 samples. Entries with further parameters state their range. For delays
above 64 samples, for long filters, and for gamma or delta below 1e-8, doubles often do not suffice and integers or many
digits replace them: seconds instead of milliseconds, with the same guarantee.
"""
