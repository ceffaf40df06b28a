"""The equations of motion, once, and the grammar of their coefficients.

Only equations and what scales them; no configuration, no data, no estimator.
"""
