"""Identification from whole records: batch least squares, instruments, maximum likelihood, tables.

What needs all the data at once, or data that are no dive.
"""
