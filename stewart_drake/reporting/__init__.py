"""Documents, figures, pages, the replay, CSV, progress."""
