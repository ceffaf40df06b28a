"""Is a bag good enough, and which manoeuvre should come next?

Uses the identification above, and has no estimator of its own.
"""
