"""Two plants with the same ports: Drake's multibody engine, and the loops closed exactly."""
