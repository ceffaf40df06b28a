"""Identification from whole records: batch least squares, instruments, maximum likelihood, tables.

Methods that need a whole record at once, or data other than dives (force tables).
"""
