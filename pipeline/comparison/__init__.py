"""Where measured and theoretical branch meet: scenes, scores, tables, figures, summary."""
