"""Controllers and motions as C, for a board."""
