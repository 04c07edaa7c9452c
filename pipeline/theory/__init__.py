"""Theory of a linear loop, a module for each question: crossings, boundary, responses, energy, passivity, optimum.

Walls are arguments, normalised as in `pipeline.loop`. `cases` has the answers that command line, service and Python
share.

The domain of every entry is that of `NormalisedLoop`: delays up to 256 samples, gamma and delta from 0, one vibration
mode, a lag, and a linear filter of up to 96 samples. Entries that take further numbers state their range. For delays
above 64 samples, for long filters, and for gamma or delta below 1e-8, doubles decide less often and integers or many
digits take their place: seconds instead of milliseconds, with the same guarantee.
"""
