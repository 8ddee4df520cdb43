"""The neural tuner of w_Q and w_R, as pure functions: its inputs and the network. No training."""
