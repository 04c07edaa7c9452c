"""One model of an experiment, one likelihood, one interval: arrays of logs in, an identified device out."""
