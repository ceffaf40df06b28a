"""The functions behind ``import rov_ident as ri`` and behind the commands: paths become
configurations and records, results come back. Nothing is computed here."""
