"""What runs or judges many simulations."""
