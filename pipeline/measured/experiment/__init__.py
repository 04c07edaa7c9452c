"""An experiment's trials together: values with intervals, boundary, optima, and the stages that store them."""
