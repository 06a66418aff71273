"""Cases with known truth, errors and success rates."""
