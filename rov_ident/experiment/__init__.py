"""Is a bag good enough, and which manoeuvre should come next? By the identification above, without
an estimator of its own."""
