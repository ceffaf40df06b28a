"""From messages at their own rates to samples on one clock, and bags as samples.

The only room that waits, despikes and blends measurements; all estimators see what it makes.
"""
