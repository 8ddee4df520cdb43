"""Studies of many simulations, and analyses before them."""
