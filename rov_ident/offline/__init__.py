"""Identification from what needs all data at once, or from data that are no dive: batch least
squares, instruments, maximum likelihood, tables."""
