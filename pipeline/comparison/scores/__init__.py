"""How well theory predicts an experiment."""
