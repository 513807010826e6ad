"""A pose near the predicted one."""
