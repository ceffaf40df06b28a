"""Programs for developers that measure nothing about the estimates themselves."""
