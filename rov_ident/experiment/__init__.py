"""Is a bag good enough, and which manoeuvre should come next?

Uses all identification above; identifies nothing itself.
"""
