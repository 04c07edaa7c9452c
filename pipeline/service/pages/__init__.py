"""Routes, figures and templates of the pages for human users."""
