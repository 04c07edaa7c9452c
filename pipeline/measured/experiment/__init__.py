"""Joint evaluation of an experiment's trials: values with intervals, boundary, optima, and stages that store them."""
