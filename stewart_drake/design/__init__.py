"""Design of the delayed LQI controller: pure functions of matrices, no LeafSystem."""
