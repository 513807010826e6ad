"""A pose without a prediction."""
