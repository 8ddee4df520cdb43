"""The control law, composed of small parts: state in, state out, no LeafSystem."""
