"""Files and bytes of messages: bags, logs, tables, and what topics carry.

The only room that knows MCAP and CDR. No estimation; what is read leaves as plain messages.
"""
