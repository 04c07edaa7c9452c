"""Pages for people: routes, figures, templates."""
