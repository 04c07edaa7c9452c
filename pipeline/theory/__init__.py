"""Theory of a linear loop. There is one module each for crossings, boundary, responses, energy, passivity, and optima.

Walls are arguments, normalised as in `pipeline.loop`. `cases` computes the results for the command line, the service
and Python.

The domain of every function is that of `NormalisedLoop`. It includes delays up to 256 samples, gamma and delta from 0,
one vibration mode, a lag, and a linear filter of up to 96 samples. Functions with further parameters state their range.
Double precision often does not suffice for delays above 64 samples, for long filters, and for gamma or delta below
1e-8. Integers or many digits are then used instead. They take seconds instead of milliseconds, with the same guarantee.
"""
