"""How many trials it takes: the planner, the thesis's procedure, bisection and random walls on simulated devices."""
