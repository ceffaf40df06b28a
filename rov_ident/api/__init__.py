"""The functions behind ``import rov_ident as ri`` and behind the commands: one path for both.

Knows every room above and computes nothing itself: paths become configurations and records, results
come back. `rov_ident/__init__.py` lists what is public.
"""
