"""Joint evaluation of an experiment's trials: values with intervals, boundary, optima, and the stages that store
them."""
