"""The equations of motion, once, the grammar of their coefficients, and what scales them; no
configuration, no data, no estimator."""
