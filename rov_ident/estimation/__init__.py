"""The recursive estimators: RLS and UKF as `init`, `step` and `fold`, live or over a bag.

What a node runs. Nothing here needs all the data at once.
"""
